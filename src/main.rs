//! The program `fpmcl`.

use std::process::ExitCode;

fn main() -> ExitCode {
    ExitCode::from(fpmcl::app::main(std::env::args_os()))
}
