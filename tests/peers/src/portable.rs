//! The loss of a portable build for any CPU of this architecture. This program and a portable build run in turns.

use std::{
    env, fs,
    path::{Path, PathBuf},
    process::{self, Command, Stdio},
};

use crate::{
    problem::Problem,
    report::{self, Figure, Report, aligned},
    spaces::Setting,
    structures::Kind,
};

const TURNS: usize = 5;

/// Runs both in turns, and prints the medians of both, and of their ratios in each turn.
///
/// # Errors
/// One of the two cannot be run, or fails.
pub fn run(program: &Path, settings: &[Setting], report: &mut Report) -> Result<String, Problem> {
    let own = env::current_exe().map_err(|source| Problem::Run {
        program: PathBuf::from("this program"),
        source,
    })?;
    let mut runs: [Vec<Vec<Figure>>; 2] = [Vec::new(), Vec::new()];
    for _ in 0..TURNS {
        runs[0].push(figures_of(&own, settings)?);
        runs[1].push(figures_of(program, settings)?);
    }
    let [natives, portables] = &runs;
    let header = [
        "space",
        "op",
        "unit",
        "structure",
        "native",
        "portable",
        "portable/native",
    ];
    let mut lines = vec![header.map(str::to_owned).to_vec()];
    let (mut native, mut portable) = (natives[0].clone(), portables[0].clone());
    for at in 0..native.len() {
        // The ratio is taken within a turn, because both of its runs had the same load on the machine.
        let turns = natives.iter().zip(portables);
        let ratio = median(turns.map(|(native, portable)| portable[at].value / native[at].value));
        native[at].value = median(natives.iter().map(|run| run[at].value));
        portable[at].value = median(portables.iter().map(|run| run[at].value));
        lines.push(vec![
            native[at].space.clone(),
            native[at].op.clone(),
            native[at].unit.clone(),
            native[at].structure.clone(),
            format!("{:.2}", native[at].value),
            format!("{:.2}", portable[at].value),
            format!("{ratio:.2}"),
        ]);
    }
    report.extend(native);
    report.extend(portable.into_iter().map(|figure| Figure {
        structure: format!("{}-portable", figure.structure),
        ..figure
    }));
    Ok(aligned(&lines))
}

/// Our figures as measured by a program.
fn figures_of(program: &Path, settings: &[Setting]) -> Result<Vec<Figure>, Problem> {
    let failed = |source| Problem::Run {
        program: program.to_owned(),
        source,
    };
    let json = env::temp_dir().join(format!("wayfold-peers-{}.json", process::id()));
    let names = |names: Vec<&str>| names.join(",");
    let status = Command::new(program)
        .args(["--quick", "--rounds", "1", "--structures"])
        .arg(names(vec![Kind::Wayfold.name(), Kind::WayfoldRest.name()]))
        .arg("--spaces")
        .arg(names(settings.iter().map(|setting| setting.name).collect()))
        .arg("--json")
        .arg(&json)
        .stdout(Stdio::null())
        .status()
        .map_err(failed)?;
    if !status.success() {
        return Err(failed(std::io::Error::other(status.to_string())));
    }
    let mut figures = report::read(&json)?;
    fs::remove_file(&json).map_err(failed)?;
    figures
        .retain(|figure| figure.data == "uniform" && figure.op != "memory" && figure.op != "rrt");
    Ok(figures)
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
