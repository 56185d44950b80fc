//! A file of settings: several phases, one after the other.

use std::{fs, path::Path};

use clap::Args;
use toml::{Table, Value};

use super::{
    error::LoadError,
    settings::{Phase, PhaseSettings, RunSettings, parsed},
};

/// The settings of a scenario.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Scenario {
    pub(super) run: RunSettings,
    /// The settings of every phase that has none of its own.
    all: PhaseSettings,
    /// The phases, with their names.
    phases: Vec<(String, PhaseSettings)>,
}

impl Scenario {
    pub(super) fn read(path: &Path) -> Result<Scenario, LoadError> {
        let text = fs::read_to_string(path).map_err(|source| LoadError::ScenarioFile {
            path: path.to_owned(),
            source,
        })?;
        Scenario::parse(&text).map_err(|problem| LoadError::Scenario {
            path: path.to_owned(),
            problem,
        })
    }

    fn parse(text: &str) -> Result<Scenario, String> {
        // The message shows the line and the column, each on a line of its own.
        let syntax = |error: toml::de::Error| error.to_string().trim_end().to_owned();
        let mut table: Table = text.parse().map_err(syntax)?;
        let phases = table.remove("phase").unwrap_or(Value::Array(Vec::new()));
        let phases = phases
            .as_array()
            .and_then(|all| all.iter().map(Value::as_table).collect());
        let phases: Vec<&Table> = phases.ok_or("phase: begin each phase with a line [[phase]]")?;
        let all: Settings = parsed(options(&table)?)?;
        let numbered = phases.into_iter().zip(1..);
        Ok(Scenario {
            run: all.run,
            all: all.phase,
            phases: numbered
                .map(|(table, number)| phase(number, table))
                .collect::<Result<_, _>>()?,
        })
    }

    /// The phases under the settings of the command line, which go first. Without phases there is one.
    pub(super) fn phases(&self, flags: &PhaseSettings) -> Vec<Phase> {
        let phase =
            |(name, own): &(String, PhaseSettings)| flags.or(&own.or(&self.all)).phase(name);
        match self.phases.as_slice() {
            [] => vec![flags.or(&self.all).phase("run")],
            phases => phases.iter().map(phase).collect(),
        }
    }
}

/// The settings of a whole file.
#[derive(Args)]
struct Settings {
    #[command(flatten)]
    run: RunSettings,
    #[command(flatten)]
    phase: PhaseSettings,
}

/// The options of the same names and values as the keys of a table.
fn options(table: &Table) -> Result<Vec<String>, String> {
    let option = |(key, value): (&String, &Value)| match value {
        Value::String(text) => Ok(Some(format!("--{key}={text}"))),
        Value::Integer(number) => Ok(Some(format!("--{key}={number}"))),
        Value::Float(number) => Ok(Some(format!("--{key}={number}"))),
        Value::Boolean(is_set) => Ok(is_set.then(|| format!("--{key}"))),
        other => Err(format!(
            "{key}: a value of the type {} does not fit",
            other.type_str()
        )),
    };
    table
        .iter()
        .filter_map(|entry| option(entry).transpose())
        .collect()
}

/// Phase `number` of the file, counted from 1.
fn phase(number: usize, table: &Table) -> Result<(String, PhaseSettings), String> {
    let mut table = table.clone();
    let name = match table.remove("name") {
        None => format!("phase {number}"),
        Some(Value::String(name)) if !name.is_empty() => name,
        Some(_) => return Err(format!("phase {number}: name: expected a text, in quotes")),
    };
    let settings = options(&table).and_then(parsed);
    let settings = settings.map_err(|problem| format!("phase {number} ({name}): {problem}"))?;
    Ok((name, settings))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    const TWO: &str = r#"
seed = 7
batch = 2
range = "-1,1"

[[phase]]
name = "calm"
rate = 100
duration = "5s"

[[phase]]
mix = "knn=1"
workers = 3
batch = 4
"#;

    #[test]
    fn phases_have_the_settings_of_the_file_and_their_own() {
        let scenario = Scenario::parse(TWO).unwrap();
        assert_eq!(scenario.run.seed(), 7);
        let phases = scenario.phases(&PhaseSettings::default());
        let names: Vec<_> = phases.iter().map(|phase| phase.name.as_str()).collect();
        assert_eq!(names, ["calm", "phase 2"]);
        assert_eq!((phases[0].rate, phases[0].batch), (Some(100.0), 2));
        assert_eq!(phases[0].duration, Some(Duration::from_secs(5)));
        assert_eq!((phases[1].workers, phases[1].batch), (3, 4));
        assert_eq!(phases[1].mix.to_string(), "knn=1");
    }

    #[test]
    fn options_go_before_the_file() {
        let flags = parsed(["--batch=9"]).unwrap();
        let phases = Scenario::parse(TWO).unwrap().phases(&flags);
        assert!(phases.iter().all(|phase| phase.batch == 9));
        assert_eq!(Scenario::default().phases(&flags).len(), 1);
    }

    #[test]
    fn a_wrong_file_says_where_and_what_was_meant() {
        for (text, expected) in [
            ("sede = 1", "a similar argument exists: '--seed'"),
            (
                "[[phases]]\nrate = 1",
                "phases: a value of the type array does not fit",
            ),
            ("[phase]\nrate = 1", "[[phase]]"),
            ("phase = 1", "[[phase]]"),
            (
                "[[phase]]\n[[phase]]\nname = \"b\"\nraet = 5",
                "phase 2 (b): unexpected argument '--raet' found\n\n  tip: a similar argument exists: '--rate'",
            ),
            ("[[phase]]\nseed = 1", "unexpected argument '--seed'"),
            (
                "rate = 0",
                "'0' for '--rate <CALLS>': expected calls per second",
            ),
            (
                "[[phase]]\nmix = \"kn=1\"",
                "phase 1 (phase 1): invalid value 'kn=1' for '--mix <VERB=WEIGHT,...>': \"kn\" is not a verb",
            ),
            (
                "duration = 5",
                "'5' for '--duration <TIME>': expected a number above 0 and its unit",
            ),
            ("rate = [1]", "rate: a value of the type array does not fit"),
            ("face = \"grcp\"", "[possible values: grpc, zenoh, shared]"),
            ("[[phase]]\nname = 3", "phase 1: name: expected a text"),
            ("rate = ", "line 1"),
        ] {
            let error = Scenario::parse(text).unwrap_err();
            assert!(error.contains(expected), "{text:?}: {error}");
        }
    }
}
