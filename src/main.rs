//! The program `fpmcl`.

use std::process::ExitCode;

fn main() -> ExitCode {
    ExitCode::from(fpmcl::main(std::env::args_os()))
}
