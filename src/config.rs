//! What a user configures: one struct per command, composed of the stages' own.
