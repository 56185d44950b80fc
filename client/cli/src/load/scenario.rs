//! A file of settings: several phases, one after the other.

use std::{fs, path::Path};

use toml::{Table, Value};

use super::{
    error::LoadError,
    settings::{Phase, PhaseSettings, RunSettings, unknown},
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
        let table: Table = text.parse().map_err(|error: toml::de::Error| {
            // The message shows the line and the column, each on a line of its own.
            error.to_string().trim_end().to_owned()
        })?;
        let mut scenario = Scenario::default();
        for (key, value) in &table {
            match key.as_str() {
                "phase" => scenario.phases = phases(value)?,
                key if PhaseSettings::KEYS.contains(&key) => {
                    set(key, value, |text| scenario.all.set(key, text))?;
                }
                key => set(key, value, |text| scenario.run.set(key, text))
                    .map_err(|problem| or_unknown(key, problem))?,
            }
        }
        Ok(scenario)
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

/// The error of a key that may be none of the whole file's.
fn or_unknown(key: &str, problem: String) -> String {
    if RunSettings::KEYS.contains(&key) {
        return problem;
    }
    let known = [&["phase"][..], &PhaseSettings::KEYS, &RunSettings::KEYS].concat();
    unknown(key, &known)
}

/// Sets a value by its text. The parsers of the options read numbers, words and lists of numbers alike.
fn set(
    key: &str,
    value: &Value,
    set: impl FnOnce(&str) -> Result<(), String>,
) -> Result<(), String> {
    let text = match value {
        Value::String(text) => text.clone(),
        Value::Integer(number) => number.to_string(),
        Value::Float(number) => number.to_string(),
        Value::Boolean(is_set) => is_set.to_string(),
        other => {
            return Err(format!(
                "{key}: a value of the type {} does not fit",
                other.type_str()
            ));
        }
    };
    let shown = match value.is_str() {
        true => format!("{text:?}"),
        false => text.clone(),
    };
    set(&text).map_err(|problem| match problem.starts_with("unknown key") {
        true => problem,
        false => format!("{key} = {shown}: {problem}"),
    })
}

fn phases(value: &Value) -> Result<Vec<(String, PhaseSettings)>, String> {
    let tables = value
        .as_array()
        .map(|values| values.iter().map(Value::as_table));
    let tables: Option<Vec<&Table>> = tables.and_then(Iterator::collect);
    let tables = tables.ok_or("phase: begin each phase with a line [[phase]]")?;
    let numbered = tables.into_iter().enumerate();
    numbered.map(|(i, table)| phase(i + 1, table)).collect()
}

/// Phase `number` of the file, counted from 1.
fn phase(number: usize, table: &Table) -> Result<(String, PhaseSettings), String> {
    let name = match table.get("name") {
        None => format!("phase {number}"),
        Some(Value::String(name)) if !name.is_empty() => name.clone(),
        Some(_) => return Err(format!("phase {number}: name: expected a text, in quotes")),
    };
    let mut settings = PhaseSettings::default();
    for (key, value) in table.iter().filter(|(key, _)| *key != "name") {
        let is_known = PhaseSettings::KEYS.contains(&key.as_str());
        let done = match is_known {
            true => set(key, value, |text| settings.set(key, text)),
            false if RunSettings::KEYS.contains(&key.as_str()) => Err(format!(
                "{key} is a setting of the whole run: move it above the first [[phase]]"
            )),
            false => Err(unknown(
                key,
                &[&["name"], &PhaseSettings::KEYS[..]].concat(),
            )),
        };
        done.map_err(|problem| format!("phase {number} ({name}): {problem}"))?;
    }
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
        let mut flags = PhaseSettings::default();
        flags.set("batch", "9").unwrap();
        let phases = Scenario::parse(TWO).unwrap().phases(&flags);
        assert!(phases.iter().all(|phase| phase.batch == 9));
        assert_eq!(Scenario::default().phases(&flags).len(), 1);
    }

    #[test]
    fn a_wrong_file_says_where_and_what_was_meant() {
        for (text, expected) in [
            ("sede = 1", "unknown key \"sede\"; did you mean seed?"),
            (
                "[[phases]]\nrate = 1",
                "unknown key \"phases\"; did you mean phase?",
            ),
            ("[phase]\nrate = 1", "[[phase]]"),
            ("phase = 1", "[[phase]]"),
            (
                "[[phase]]\n[[phase]]\nname = \"b\"\nraet = 5",
                "phase 2 (b): unknown key \"raet\"; did you mean rate?",
            ),
            ("[[phase]]\nseed = 1", "move it above the first [[phase]]"),
            ("rate = 0", "rate = 0: expected calls per second"),
            (
                "[[phase]]\nmix = \"kn=1\"",
                "phase 1 (phase 1): mix = \"kn=1\": \"kn\" is not a verb",
            ),
            (
                "duration = 5",
                "duration = 5: expected a number above 0 and its unit",
            ),
            ("rate = [1]", "rate: a value of the type array does not fit"),
            ("face = \"grcp\"", "expected grpc, zenoh or shared"),
            ("[[phase]]\nname = 3", "phase 1: name: expected a text"),
            ("rate = ", "line 1"),
        ] {
            let error = Scenario::parse(text).unwrap_err();
            assert!(error.contains(expected), "{text:?}: {error}");
        }
    }
}
