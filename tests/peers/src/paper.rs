//! Figures 5, 6 and 7 of the paper, measured again: 100 queries for the nearest of 50,000 uniform points.
//!
//! Machines have changed since, so only ratios to brute force are comparable: ours to our brute force, the paper's to
//! its own.

use std::time::Duration;

use crate::{
    check::Case,
    data::{self, Data},
    measure::{self, Effort},
    problem::Problem,
    report::{Op, Report, aligned, none},
    spaces,
    structures::Kind,
};

const TABLES: &str = include_str!("../paper-tables.csv");
const POINTS: usize = 50_000;
const QUERIES: usize = 100;

/// The maximum construction time of a cover tree. It grows from space to space of a figure; the spaces after one that
/// exceeds it are left out.
const MAX_CONSTRUCTION: Duration = Duration::from_secs(20);

/// One line of the paper's tables, in seconds.
struct Line {
    figure: u32,
    /// The notation of the paper.
    space: String,
    naive: f64,
    /// Construction and queries of MPNN, of a cover tree, of sb(S).
    peers: [(f64, f64); 3],
}

impl Line {
    fn parse(line: &str) -> Option<Line> {
        let fields: Vec<&str> = line.split(',').collect();
        let [figure, space, _dimension, numbers @ ..] = fields.as_slice() else {
            return None;
        };
        let numbers: Vec<f64> = numbers.iter().map_while(|text| text.parse().ok()).collect();
        let [mpnn, mpnn_asked, naive, cover, cover_asked, sbs, sbs_asked] = numbers[..] else {
            return None;
        };
        Some(Line {
            figure: figure.parse().ok()?,
            space: (*space).to_owned(),
            naive,
            peers: [(mpnn, mpnn_asked), (cover, cover_asked), (sbs, sbs_asked)],
        })
    }

    /// The space in our text form: R^n, (S1)^n, (R3xRP3)^n.
    fn text(&self) -> Option<String> {
        let (factor, power) = self.space.rsplit_once('^')?;
        match factor {
            "R" => Some(format!("R{power}")),
            "(S1)" => Some(format!("SO2^{power}")),
            "(R3xRP3)" => Some(format!("(R3*SO3:0.15)^{power}")),
            _ => None,
        }
    }
}

/// Measures all lines, and prints them next to the paper's.
///
/// # Errors
/// A structure does not equal brute force.
pub fn run(rounds: usize, report: &mut Report) -> Result<String, Problem> {
    let effort = Effort {
        rounds,
        searches: &[Op::Knn1],
        growth_rounds: 1,
        longest_rrt: Duration::ZERO,
    };
    let mut tables = [queries_header(), construction_header()];
    let (mut figure, mut kinds) = (0, Kind::PAPER.to_vec());
    for line in TABLES.lines().filter_map(Line::parse) {
        let Some(text) = line.text() else {
            continue;
        };
        if line.figure != figure {
            figure = line.figure;
            kinds = Kind::PAPER.to_vec();
            tables.iter_mut().for_each(|table| table.push(Vec::new()));
        }
        let space = spaces::parse(&text)?;
        let (points, queries) = data::generate(&space, Data::Uniform, POINTS, QUERIES)?;
        let (name, rows) = (&line.space, (&points, &queries));
        let case = Case::new(name, &space, Data::Uniform, rows, QUERIES);
        measure::measure(&case, &kinds, effort, report)?;
        eprintln!("figure {figure}: {name}");
        let [searched, constructed] = lines(&line, report);
        tables[0].push(searched);
        tables[1].push(constructed);
        let build = report
            .uniform(name, POINTS, Kind::CoverTree, Op::Build)
            .unwrap_or(0.0);
        if build * 1e-9 * POINTS as f64 > MAX_CONSTRUCTION.as_secs_f64() {
            kinds.retain(|kind| *kind != Kind::CoverTree);
        }
    }
    let [searched, constructed] = &tables;
    Ok(format!(
        "{QUERIES} queries for the nearest of {POINTS} uniform points, weights 1 for R^3 and 0.15 for RP^3.\n\
         How many times as fast as brute force (scalar, each to its own; the paper's columns are its own figures, sb(S) has \
         no package), and how many times as fast wayfold-rest is as mpnn, our version of the paper's tree:\n\n{}\n\
         Construction, in times of brute force's {QUERIES} queries (wayfold: one point after the other):\n\n{}\n\
         –: a cover tree whose construction would take more than about {} s, as in the space before.\n",
        aligned(searched),
        aligned(constructed),
        MAX_CONSTRUCTION.as_secs(),
    ))
}

/// Our index, the paper's tree, and the structures of packages, without brute force.
const MEASURED: [Kind; 5] = [
    Kind::Wayfold,
    Kind::WayfoldRest,
    Kind::Mpnn,
    Kind::SimdScan,
    Kind::CoverTree,
];

/// The ratio that shows the gain from wide nodes, tight boxes and vector registers over the paper's tree.
const REST_TO_MPNN: &str = "rest/mpnn";

fn queries_header() -> Vec<Vec<String>> {
    let mut header = vec!["space".to_owned(), "brute, ms".to_owned()];
    header.extend(MEASURED.map(|kind| kind.name().to_owned()));
    header.extend(
        [
            "paper: MPNN",
            "paper: cover tree",
            "paper: sb(S)",
            REST_TO_MPNN,
        ]
        .map(str::to_owned),
    );
    vec![header]
}

fn construction_header() -> Vec<Vec<String>> {
    let mut header = queries_header();
    // Brute force stores the points unchanged and constructs nothing.
    header[0].retain(|name| name != Kind::SimdScan.name() && name != REST_TO_MPNN);
    header
}

/// One line of each table.
fn lines(line: &Line, report: &Report) -> [Vec<String>; 2] {
    let query = |kind| report.uniform(&line.space, POINTS, kind, Op::Knn1);
    let brute = query(Kind::Brute).unwrap_or(f64::NAN);
    let first = [
        line.space.clone(),
        format!("{:.1}", brute * QUERIES as f64 / 1e3),
    ];
    let mut searched = first.to_vec();
    let mut constructed = first.to_vec();
    for kind in MEASURED {
        searched.push(query(kind).map_or_else(none, |own| format!("{:.1}", brute / own)));
        let op = if kind.builds() { Op::Build } else { Op::Insert };
        // Nanoseconds per point are compared with microseconds per query.
        let times = |ns: f64| ns * POINTS as f64 / (brute * 1e3 * QUERIES as f64);
        if kind != Kind::SimdScan {
            let built = report.uniform(&line.space, POINTS, kind, op);
            constructed.push(built.map_or_else(none, |ns| format!("{:.2}", times(ns))));
        }
    }
    for (build, search) in line.peers {
        searched.push(format!("{:.1}", line.naive / search));
        constructed.push(format!("{:.2}", build / line.naive));
    }
    let gain = query(Kind::Mpnn).zip(query(Kind::WayfoldRest));
    searched.push(gain.map_or_else(none, |(paper, rest)| format!("{:.2}", paper / rest)));
    [searched, constructed]
}
