//! The command line. `voxcast --help` is its manual.

#![allow(unreachable_pub, reason = "a program has no public items")]

mod cli;

use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    let arguments = cli::Arguments::parse();
    match arguments.run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            cli::complain(&error);
            ExitCode::from(1)
        }
    }
}
