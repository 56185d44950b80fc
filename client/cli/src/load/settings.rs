//! The settings of a run and of its phases: options of the command line, and keys of a scenario.

use std::{ffi::OsString, time::Duration};

use clap::{Args, Command, ValueEnum};
use serde_json::Value;
use wayfold::Credentials;

use super::{error::LoadError, mix::Mix, states::Range};
use crate::parse;

/// The settings of one phase, where they are given.
#[derive(Clone, Debug, Default, PartialEq, clap::Args)]
pub(super) struct PhaseSettings {
    /// The concurrent callers, each with a connection, a session or a copy of its own [default: 8]
    #[arg(long, value_name = "N", value_parser = workers)]
    workers: Option<usize>,
    /// The verbs (insert, knn, query, get, stream: knn over one stream) and their weights [default: insert=1,knn=8,query=1,get=1]
    #[arg(long, value_name = "VERB=WEIGHT,...", value_parser = Mix::parse)]
    mix: Option<Mix>,
    /// The states (or ids) of a call [default: 1]
    #[arg(long, value_name = "N", value_parser = batch)]
    batch: Option<usize>,
    /// The neighbours that knn and stream ask for [default: 10]
    #[arg(short, long, value_name = "K", value_parser = k)]
    k: Option<u32>,
    /// The radius of query [default: the distance of the k-th neighbour, the median of some probes]
    #[arg(long, value_name = "R", value_parser = parse::distance, allow_negative_numbers = true)]
    radius: Option<f64>,
    /// Open loop: calls per second over all workers, due at even distances; latency counts from the due time
    ///
    /// Without it the loop is closed: each worker makes its next call when it has the answer to the last one.
    #[arg(long, value_name = "CALLS", value_parser = rate, allow_negative_numbers = true)]
    rate: Option<f64>,
    /// The time of the run, or of each phase: 500ms, 30s, 5m [default: 10s, if --calls is not given]
    #[arg(long, value_name = "TIME", value_parser = parse::duration)]
    duration: Option<Duration>,
    /// Ends the run, or each phase, after this many calls in all
    #[arg(long, value_name = "N", value_parser = count)]
    calls: Option<u64>,
}

/// The settings of the whole run, where they are given.
#[derive(Clone, Debug, Default, PartialEq, clap::Args)]
pub(super) struct RunSettings {
    /// The way to the server [default: grpc]
    #[arg(long, value_enum, value_name = "FACE")]
    face: Option<Face>,
    /// The server's address for Zenoh, as tcp/127.0.0.1:7448
    #[arg(long, value_name = "LOCATOR")]
    locator: Option<String>,
    /// The prefix of the server's keys in Zenoh [default: wayfold/v1]
    #[arg(long, value_name = "PREFIX")]
    prefix: Option<String>,
    /// The interval of real coordinates; angles and rotations are drawn evenly [default: 0,1]
    #[arg(long, value_name = "LOW,HIGH", value_parser = Range::parse, allow_hyphen_values = true)]
    range: Option<Range>,
    /// Equal seeds make equal calls [default: 1]
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Makes the calls of the first phase for this time before anything is counted
    #[arg(long, value_name = "TIME", value_parser = parse::duration)]
    pub(super) warmup: Option<Duration>,
    /// Stores this many points before the run [default: 1000 if the index is empty and the mix reads, else 0]
    #[arg(long, value_name = "N", value_parser = count_or_none)]
    pub(super) fill: Option<u64>,
    /// Leaves the points of the run in the index
    #[arg(long)]
    pub(super) keep: bool,
}

/// The way to the server.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(super) enum Face {
    /// A gRPC connection for each worker; every call goes to the server
    #[default]
    Grpc,
    /// A Zenoh session and a shared index for each worker; reads are answered in this process
    Zenoh,
    /// A shared index over gRPC for each worker; reads are answered in this process
    Shared,
}

impl Face {
    pub(super) fn name(self) -> &'static str {
        match self {
            Face::Grpc => "grpc",
            Face::Zenoh => "zenoh",
            Face::Shared => "shared",
        }
    }
}

impl PhaseSettings {
    /// These settings, and those of `other` where these have none.
    pub(super) fn or(&self, other: &PhaseSettings) -> PhaseSettings {
        // An end that is given replaces both ends.
        let (duration, calls) = match (self.duration, self.calls) {
            (None, None) => (other.duration, other.calls),
            given => given,
        };
        PhaseSettings {
            workers: self.workers.or(other.workers),
            mix: self.mix.or(other.mix),
            batch: self.batch.or(other.batch),
            k: self.k.or(other.k),
            radius: self.radius.or(other.radius),
            rate: self.rate.or(other.rate),
            duration,
            calls,
        }
    }

    /// The phase of these settings, with the defaults.
    pub(super) fn phase(&self, name: &str) -> Phase {
        const DURATION: Duration = Duration::from_secs(10);
        Phase {
            name: name.to_owned(),
            workers: self.workers.unwrap_or(8),
            mix: self.mix.unwrap_or_default(),
            batch: self.batch.unwrap_or(1),
            k: self.k.unwrap_or(10),
            radius: self.radius,
            rate: self.rate,
            duration: self.duration.or(match self.calls {
                Some(_) => None,
                None => Some(DURATION),
            }),
            calls: self.calls,
        }
    }
}

/// The settings that options set; the problem of a wrong option in words.
pub(super) fn parsed<S: Args>(
    options: impl IntoIterator<Item = impl Into<OsString> + Clone>,
) -> Result<S, String> {
    let command = S::augment_args(Command::new("load").no_binary_name(true));
    let matches = command
        .disable_help_flag(true)
        .try_get_matches_from(options);
    let settings = matches.and_then(|matches| S::from_arg_matches(&matches));
    settings.map_err(|error| {
        let text = error.render().to_string();
        // The rest is about the command line.
        let problem = text.split("\n\nUsage").next().unwrap_or_default();
        let problem = problem.split("\n\nFor more").next().unwrap_or_default();
        problem.trim_start_matches("error: ").trim().to_owned()
    })
}

/// One phase, with every setting decided but the radius.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Phase {
    pub(super) name: String,
    pub(super) workers: usize,
    pub(super) mix: Mix,
    pub(super) batch: usize,
    pub(super) k: u32,
    /// `None` if probes choose it, or once they had nothing to choose by.
    pub(super) radius: Option<f64>,
    pub(super) rate: Option<f64>,
    pub(super) duration: Option<Duration>,
    pub(super) calls: Option<u64>,
}

impl RunSettings {
    /// These settings, and those of `other` where these have none.
    pub(super) fn or(self, other: RunSettings) -> RunSettings {
        RunSettings {
            face: self.face.or(other.face),
            locator: self.locator.or(other.locator),
            prefix: self.prefix.or(other.prefix),
            range: self.range.or(other.range),
            seed: self.seed.or(other.seed),
            warmup: self.warmup.or(other.warmup),
            fill: self.fill.or(other.fill),
            keep: self.keep || other.keep,
        }
    }

    /// The address of a server, with the defaults; `server` is the one of gRPC.
    pub(super) fn address(&self, server: &str) -> Result<Address, LoadError> {
        let face = self.face.unwrap_or_default();
        let (server, prefix) = match (face, &self.locator, &self.prefix) {
            (Face::Zenoh, locator, prefix) => {
                let prefix = prefix.as_deref().unwrap_or("wayfold/v1");
                let locator = locator.clone().ok_or(LoadError::NoLocator)?;
                (locator, Some(prefix.to_owned()))
            }
            (_, Some(_), _) => return Err(LoadError::NotZenoh { option: "locator" }),
            (_, None, Some(_)) => return Err(LoadError::NotZenoh { option: "prefix" }),
            (_, None, None) => (server.to_owned(), None),
        };
        Ok(Address {
            face,
            server,
            prefix,
            credentials: Credentials::default(),
            zenoh_tls: Value::Null,
        })
    }

    pub(super) fn range(&self) -> Range {
        self.range.unwrap_or_default()
    }

    pub(super) fn seed(&self) -> u64 {
        self.seed.unwrap_or(1)
    }
}

/// A face of a server, and its address there.
#[derive(Clone, Debug)]
pub(super) struct Address {
    pub(super) face: Face,
    /// The URL of gRPC, or the locator of Zenoh.
    pub(super) server: String,
    /// The prefix of the keys, of Zenoh alone.
    pub(super) prefix: Option<String>,
    pub(super) credentials: Credentials,
    /// The certificates in Zenoh's words.
    #[cfg_attr(
        not(feature = "zenoh"),
        expect(dead_code, reason = "of the other build")
    )]
    pub(super) zenoh_tls: Value,
}

fn workers(text: &str) -> Result<usize, String> {
    whole(text, 1..=1024).map(|number| number as usize)
}

fn batch(text: &str) -> Result<usize, String> {
    whole(text, 1..=100_000).map(|number| number as usize)
}

fn k(text: &str) -> Result<u32, String> {
    whole(text, 1..=u64::from(u32::MAX)).map(|number| number as u32)
}

fn count(text: &str) -> Result<u64, String> {
    whole(text, 1..=1 << 53)
}

fn count_or_none(text: &str) -> Result<u64, String> {
    whole(text, 0..=1 << 53)
}

fn whole(text: &str, range: std::ops::RangeInclusive<u64>) -> Result<u64, String> {
    let number = text.parse().ok().filter(|number| range.contains(number));
    let (low, high) = (range.start(), range.end());
    number.ok_or_else(|| format!("expected a whole number from {low} to {high}"))
}

/// Calls per second: a number from 0.001 to 10,000,000.
fn rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(rate) if (0.001..=1e7).contains(&rate) => Ok(rate),
        _ => Err(
            "expected calls per second, from 0.001 to 10000000; leave --rate out for a closed loop"
                .to_owned(),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(options: &[&str]) -> PhaseSettings {
        parsed(options.iter().copied()).unwrap()
    }

    #[test]
    fn a_number_of_calls_replaces_the_time_of_a_phase() {
        assert_eq!(
            settings(&[]).phase("").duration,
            Some(Duration::from_secs(10))
        );
        assert_eq!(settings(&["--calls=5"]).phase("").duration, None);
        let flags = settings(&["--calls=5"]);
        let merged = flags.or(&settings(&["--duration=5m", "--rate=3"]));
        assert_eq!((merged.duration, merged.calls), (None, Some(5)));
        assert_eq!(merged.rate, Some(3.0));
    }

    #[test]
    fn wrong_values_are_refused() {
        for (key, text) in [
            ("rate", "0"),
            ("rate", "-1"),
            ("rate", "nan"),
            ("rate", "inf"),
            ("workers", "0"),
            ("workers", "1025"),
            ("batch", "0"),
            ("k", "0"),
            ("calls", "0"),
            ("calls", "1.5"),
            ("duration", "5"),
            ("radius", "-1"),
        ] {
            let refused = parsed::<PhaseSettings>([format!("--{key}={text}")]);
            assert!(refused.unwrap_err().contains("expected"), "{key}={text}");
        }
    }
}
