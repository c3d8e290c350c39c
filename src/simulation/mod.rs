//! A street with a known answer: a procedural world, a drive through it, its scans.
