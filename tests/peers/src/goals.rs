//! The goals of the index against its peers, and the figures that a run reached: one line for each goal.

use crate::{
    LARGE_POINTS, POINTS,
    report::{Op, Report, aligned},
    spaces::SETTINGS,
    structures::Kind,
};

/// The value with which ours is compared.
#[derive(Clone, Copy, Debug)]
enum Baseline {
    /// The best of these.
    Best(&'static [Kind]),
    /// A value, and its description.
    Value(f64, &'static str),
}

use Baseline::{Best, Value};

/// The ratio of a peer's figure to ours, for uniform data.
#[derive(Clone, Copy, Debug)]
struct Goal {
    space: &'static str,
    n: usize,
    op: Op,
    ours: Kind,
    against: Baseline,
    least: f64,
}

const KIDDO: Baseline = Best(&[Kind::Kiddo]);
const KIDDO_MUTABLE: Baseline = Best(&[Kind::KiddoMutable]);
const STATIC: Baseline = Best(&[Kind::Kiddo, Kind::Nanoflann]);
const GNAT: Baseline = Best(&[Kind::OmplGnat]);
const SCAN: Baseline = Best(&[Kind::SimdScan]);
const AT_REST: Baseline = Best(&[Kind::WayfoldRest]);

/// The maximum ratio of a search's time in a growing index to its time at rest.
const GROWING: f64 = 1.5;

/// The size of a point of SE3: seven coordinates, id, tag and revision.
const POINT_BYTES: Baseline = Value(80.0, "80 bytes of numbers");

/// All goals.
fn goals() -> Vec<Goal> {
    use Kind::{Wayfold as Grows, WayfoldRest as Rests};
    let mut goals = Vec::new();
    let mut nearest = |space, n, ours, against, [one, ten]: [f64; 2]| {
        for (op, least) in [(Op::Knn1, one), (Op::Knn10, ten)] {
            goals.push(Goal {
                space,
                n,
                op,
                ours,
                against,
                least,
            });
        }
    };
    for space in ["SE3", "SE3-SUM"] {
        nearest(space, POINTS, Grows, GNAT, [20.0, 15.0]);
        nearest(space, LARGE_POINTS, Rests, GNAT, [20.0, 15.0]);
    }
    for space in ["SE2", "R12", "SO2^6"] {
        nearest(space, POINTS, Grows, STATIC, [1.0; 2]);
        nearest(space, POINTS, Rests, STATIC, [1.3; 2]);
        nearest(space, LARGE_POINTS, Rests, STATIC, [1.3; 2]);
    }
    for space in ["SO3", "R6", "SO2^3"] {
        nearest(space, POINTS, Grows, KIDDO_MUTABLE, [1.0; 2]);
        nearest(space, POINTS, Rests, KIDDO, [1.0; 2]);
        nearest(space, LARGE_POINTS, Rests, KIDDO, [1.0; 2]);
    }
    nearest("SE3^2", POINTS, Grows, SCAN, [2.0, 1.2]);
    for space in ["SE3^4", "SE3^8", "R30"] {
        // The first ratio is required everywhere, the second where pruning or less memory traffic makes it possible.
        nearest(space, POINTS, Grows, SCAN, [1.0; 2]);
        nearest(space, POINTS, Grows, SCAN, [1.5; 2]);
        nearest(space, POINTS, Grows, GNAT, [10.0; 2]);
    }
    nearest("R3", POINTS, Rests, KIDDO, [1.0; 2]);
    nearest("R3", LARGE_POINTS, Rests, KIDDO, [1.0; 2]);
    for setting in SETTINGS.iter().filter(|setting| setting.million) {
        nearest(
            setting.name,
            LARGE_POINTS,
            Grows,
            AT_REST,
            [1.0 / GROWING; 2],
        );
    }
    let single = |space, op, ours, against, least| Goal {
        space,
        n: POINTS,
        op,
        ours,
        against,
        least,
    };
    goals.extend([
        single("SE3", Op::Rrt, Grows, GNAT, 12.0),
        single("R3", Op::Rrt, Grows, KIDDO_MUTABLE, 0.7),
        single("SE3", Op::Build, Rests, Value(300.0, "300 ns"), 1.0),
        single("SE3", Op::Memory, Rests, POINT_BYTES, 1.0 / 1.5),
    ]);
    goals
}

impl Baseline {
    fn name(self) -> String {
        match self {
            Best(kinds) => kinds
                .iter()
                .map(|kind| kind.name())
                .collect::<Vec<_>>()
                .join(", "),
            Value(_, name) => name.to_owned(),
        }
    }

    /// The value of the same measurement; none unless all of the peers were measured.
    fn value(self, goal: &Goal, report: &Report) -> Option<f64> {
        match self {
            Best(kinds) => {
                let figure = |&kind| report.uniform(goal.space, goal.n, kind, goal.op);
                let figures: Option<Vec<f64>> = kinds.iter().map(figure).collect();
                figures?.into_iter().min_by(f64::total_cmp)
            }
            Value(value, _) => Some(value),
        }
    }
}

/// The goals for which a run has measured both sides; empty if there are none.
pub fn table(report: &Report) -> String {
    let header = [
        "goal",
        "metric",
        "n",
        "op",
        "ours",
        "against",
        "their/ours",
        "least",
        "",
    ];
    let mut lines = vec![header.map(str::to_owned).to_vec()];
    for goal in goals() {
        let metric = SETTINGS.iter().find(|setting| setting.name == goal.space);
        let ours = report.uniform(goal.space, goal.n, goal.ours, goal.op);
        let theirs = goal.against.value(&goal, report);
        let (Some(metric), Some(ours), Some(theirs)) = (metric, ours, theirs) else {
            continue;
        };
        let ratio = theirs / ours;
        let state = if ratio >= goal.least {
            "reached"
        } else {
            "MISSED"
        };
        lines.push(vec![
            goal.space.to_owned(),
            metric.text.to_owned(),
            goal.n.to_string(),
            goal.op.name().to_owned(),
            goal.ours.name().to_owned(),
            goal.against.name(),
            format!("{ratio:.2}"),
            format!("{:.2}", goal.least),
            state.to_owned(),
        ]);
    }
    if lines.len() == 1 {
        return String::new();
    }
    format!("\n{}", aligned(&lines))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn goals_are_of_spaces_and_sizes_that_are_measured() {
        for goal in goals() {
            let setting = SETTINGS.iter().find(|setting| setting.name == goal.space);
            let setting = setting.expect("a space of the table");
            assert!(goal.n == POINTS || setting.million, "{goal:?}");
            assert!(goal.least > 0.0);
        }
    }

    #[test]
    fn a_goal_is_told_by_the_best_of_its_peers_once_all_are_measured() {
        let figure = |structure: Kind, value: f64| crate::report::Figure {
            space: "SE2".to_owned(),
            n: POINTS,
            data: "uniform".to_owned(),
            structure: structure.name().to_owned(),
            op: Op::Knn1.name().to_owned(),
            value,
            unit: "us".to_owned(),
        };
        let mut report = Report::default();
        report.extend([figure(Kind::Wayfold, 2.0), figure(Kind::Kiddo, 3.0)]);
        assert_eq!(table(&report), "");
        report.extend([figure(Kind::Nanoflann, 1.0)]);
        let table = table(&report);
        let line = table.lines().last().expect("a line");
        let end: Vec<&str> = line.split_whitespace().rev().take(3).collect();
        assert_eq!(end, ["MISSED", "1.00", "0.50"]);
    }
}
