//! Pictures: paths, errors, particles on the map, range images.
