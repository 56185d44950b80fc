//! What a build for any CPU of this kind loses: this program and one that was built so, in turns.

use std::{
    env, fs,
    path::{Path, PathBuf},
    process::{self, Command, Stdio},
};

use crate::{
    problem::Problem,
    report::{Figure, Report, aligned},
    spaces::Setting,
    structures::Kind,
};

const TURNS: usize = 3;

/// Runs both in turns, and prints the medians of both and their ratios.
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
    let [native, portable] = runs.map(medians);
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
    for (native, portable) in native.iter().zip(&portable) {
        let ratio = portable.value / native.value;
        lines.push(vec![
            native.space.clone(),
            native.op.clone(),
            native.unit.clone(),
            native.structure.clone(),
            format!("{:.2}", native.value),
            format!("{:.2}", portable.value),
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

/// What a program measures of ours.
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
    let text = fs::read_to_string(&json).map_err(failed)?;
    fs::remove_file(&json).map_err(failed)?;
    let mut figures: Vec<Figure> =
        serde_json::from_str(&text).map_err(|error| failed(error.into()))?;
    figures.retain(|figure| figure.data == "uniform" && figure.op != "memory");
    Ok(figures)
}

/// The median of each figure over runs that measured the same ones.
fn medians(runs: Vec<Vec<Figure>>) -> Vec<Figure> {
    let mut medians = runs[0].clone();
    for (at, median) in medians.iter_mut().enumerate() {
        let mut values: Vec<f64> = runs.iter().map(|run| run[at].value).collect();
        values.sort_by(f64::total_cmp);
        median.value = values[values.len() / 2];
    }
    medians
}
