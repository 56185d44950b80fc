//! `wayfold completions` and `wayfold man`, which call no server.

use std::io::{self, Write};

use clap::CommandFactory;
use clap_complete::Shell;
use clap_mangen::Man;

use crate::{args::Args, failure::Failure};

const COMPLETIONS_EXAMPLES: &str = "\
Examples:
  wayfold completions bash > /etc/bash_completion.d/wayfold
  wayfold completions zsh > \"${fpath[1]}/_wayfold\"
  wayfold completions fish > ~/.config/fish/completions/wayfold.fish";

/// Prints the completion script of a shell
#[derive(Debug, clap::Args)]
#[command(after_help = COMPLETIONS_EXAMPLES)]
pub(crate) struct CompletionsArgs {
    /// The shell
    #[arg(value_enum)]
    shell: Shell,
}

const MAN_EXAMPLES: &str = "\
Examples:
  wayfold man > wayfold.1
  wayfold man knn | man -l -";

/// Prints the manual page of wayfold, or of one of its commands
#[derive(Debug, clap::Args)]
#[command(after_help = MAN_EXAMPLES)]
pub(crate) struct ManArgs {
    /// The command to describe
    #[arg(value_parser = command_name)]
    command: Option<String>,
}

fn command_name(text: &str) -> Result<String, String> {
    match Args::command().find_subcommand(text) {
        Some(_) => Ok(text.to_owned()),
        None => Err("no command has this name".to_owned()),
    }
}

pub(crate) fn completions(args: &CompletionsArgs) -> Result<(), Failure> {
    // `clap_complete::generate` panics if the output is closed.
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Args::command(), "wayfold", &mut script);
    Ok(io::stdout().write_all(&script)?)
}

pub(crate) fn man(args: &ManArgs) -> Result<(), Failure> {
    // Building the command gives its subcommands their options of every command and their full names.
    let mut program = Args::command();
    program.build();
    let command = args.command.as_ref();
    let command = command.and_then(|name| program.find_subcommand(name).cloned());
    let mut page = Vec::new();
    Man::new(command.unwrap_or(program)).render(&mut page)?;
    Ok(io::stdout().write_all(&page)?)
}
