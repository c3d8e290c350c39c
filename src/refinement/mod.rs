//! A trajectory polished: a particle swarm over every pose, then smoothing.
