//! `wayfold token create`, which calls no server.

use std::{
    fmt::Write as _,
    fs::{self, OpenOptions},
    io::{self, Write},
    path::{Path, PathBuf},
};

use clap::{Subcommand, ValueEnum};
use serde::Serialize;
use sha2::{Digest, Sha256};
use time::{OffsetDateTime, format_description::well_known::Rfc3339};

use crate::{
    failure::Failure,
    output::{Format, Output},
};

const EXAMPLES: &str = "\
Examples:
  wayfold token create cell-3 --role write --index 'cell-3-*' --to cell-3.token >> identities.toml
  wayfold --token-file cell-3.token knn cell-3-arm --state 0,0,0,0,0,0,1

The entry goes to standard output, for the file of the setting access.identities; the server reads it
within a second. It has only the SHA-256 of the token. Without --to the token goes to standard error, or
with --output json to the field token of standard output: keep that secret.";

/// Makes tokens for the identities of a server
#[derive(Debug, clap::Args)]
pub(crate) struct TokenArgs {
    #[command(subcommand)]
    command: TokenCommand,
}

#[derive(Debug, Subcommand)]
enum TokenCommand {
    /// Makes a token of 256 random bits, and prints the entry of its identity
    #[command(after_help = EXAMPLES)]
    Create(CreateArgs),
}

/// A name or a pattern that the server accepts. It refuses the whole file for another name, and TOML has no raw U+007F.
fn name(text: &str) -> Result<String, &'static str> {
    match text {
        "" => Err("it is empty"),
        _ if text.contains(char::is_control) => Err("it has control characters"),
        _ => Ok(text.to_owned()),
    }
}

#[derive(Debug, clap::Args)]
struct CreateArgs {
    /// The name of the identity, which log lines show
    #[arg(value_parser = name)]
    name: String,
    /// The rights: read; write, which includes read; admin, which includes both
    #[arg(long, value_enum)]
    role: Role,
    /// The indices by name; * stands for any characters. Give it again for more; without it there are none
    #[arg(long = "index", value_name = "PATTERN", value_parser = name)]
    indexes: Vec<String>,
    /// It may read /metrics, which names all indices
    #[arg(long)]
    metrics: bool,
    /// The end of its rights: 2027-01-31T00:00:00Z
    #[arg(long, value_name = "TIME", value_parser = expiry)]
    expires: Option<String>,
    /// Write the token to a new file that only its owner can read
    #[arg(long, value_name = "FILE")]
    to: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Role {
    Read,
    Write,
    Admin,
}

#[derive(Serialize)]
struct Created<'a> {
    /// Absent if it is in a file.
    #[serde(skip_serializing_if = "Option::is_none")]
    token: Option<&'a str>,
    entry: &'a str,
}

pub(crate) fn token(args: &TokenArgs, format: Format) -> Result<(), Failure> {
    let TokenCommand::Create(args) = &args.command;
    let mut secret = [0; 32];
    getrandom::fill(&mut secret).map_err(|error| Failure::Random(error.to_string()))?;
    let token = format!("wayfold_{}", hex::encode(secret));
    let entry = entry(args, &token);
    let shown = match &args.to {
        Some(file) => {
            write_secret(file, &token)?;
            None
        }
        None => Some(&*token),
    };
    let mut output = Output::stdout(format);
    let printed = match format {
        Format::Json => output.json(&Created {
            token: shown,
            entry: &entry,
        }),
        Format::Text => output.text(entry.trim_end()),
    };
    let failed = |path: &str, source| Failure::File {
        path: path.into(),
        source,
    };
    // A broken pipe is a failure here, because the entry is lost.
    let printed = printed.and_then(|()| output.flush());
    if let (Err(_), Some(file)) = (&printed, &args.to) {
        // The token is of no use without the entry, and its file would refuse the next attempt.
        let _ = fs::remove_file(file);
    }
    printed.map_err(|source| failed("standard output", source))?;
    if let (Format::Text, Some(token)) = (format, shown) {
        let written = writeln!(io::stderr(), "the token, shown only now: {token}");
        written.map_err(|source| failed("standard error", source))?;
    }
    Ok(())
}

/// The entry of the file of identities.
fn entry(args: &CreateArgs, token: &str) -> String {
    let role = args.role.to_possible_value();
    let role = role.as_ref().map_or("", |value| value.get_name());
    // The strings of JSON are strings of TOML.
    let text = |text: &str| serde_json::Value::from(text).to_string();
    let indexes: Vec<String> = args.indexes.iter().map(|index| text(index)).collect();
    let mut entry = format!(
        "[[identity]]\nname = {}\nrole = {}\nindexes = [{}]\ntoken_sha256 = \"{}\"\n",
        text(&args.name),
        text(role),
        indexes.join(", "),
        hex::encode(Sha256::digest(token))
    );
    if args.metrics {
        entry += "metrics = true\n";
    }
    if let Some(expires) = &args.expires {
        // Writing to a string does not fail.
        let _ = writeln!(entry, "expires = {}", text(expires));
    }
    entry
}

/// A time that the server can read, and that has not come yet.
fn expiry(text: &str) -> Result<String, &'static str> {
    let time = OffsetDateTime::parse(text, &Rfc3339)
        .map_err(|_| "it is no time such as 2027-01-31T00:00:00Z")?;
    match time > OffsetDateTime::now_utc() {
        true => Ok(text.to_owned()),
        false => Err("it is past"),
    }
}

fn write_secret(file: &Path, token: &str) -> Result<(), Failure> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let failed = |source| Failure::File {
        path: file.to_owned(),
        source,
    };
    let mut opened = options.open(file).map_err(failed)?;
    let written = writeln!(opened, "{token}");
    if written.is_err() {
        let _ = fs::remove_file(file);
    }
    written.map_err(failed)
}
