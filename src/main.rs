//! The command line: parse, start logging, dispatch, exit code.

fn main() {}
