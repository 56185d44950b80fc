//! The planners on small problems: they grow the same trees with every source of neighbours, and independent code finds
//! their paths free.

use std::cell::Cell;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use wayfold::{Neighbor, States};
use wayfold_examples::{
    maze::scene::Maze,
    planning::{
        comparison::{self, Open, Trials},
        error::PlanningError,
        figures::RunTimes,
        host::Host,
        options::Source,
        path::{self, Verify},
        prm_star,
        problem::{Problem, Setting},
        report, rrt, rrt_star, sampling,
        source::TimedIndex,
    },
};

use crate::server::Server;

/// Two dead ends away from the start.
pub(crate) fn small() -> Maze {
    Maze::between((0, 0), (2, 3))
}

/// A small problem, whose states are drawn only from its part of the maze.
struct Corner(Maze, [(f64, f64); 2]);

impl Corner {
    fn new() -> Corner {
        Corner(small(), [(0.0, 3.0), (4.0, 8.0)])
    }
}

impl Problem for Corner {
    fn setting(&self) -> &Setting {
        self.0.setting()
    }

    fn bounds(&self) -> &[(f64, f64)] {
        &self.1
    }

    fn is_free(&self, state: &[f64]) -> bool {
        self.0.is_free(state)
    }

    fn resolution(&self) -> f64 {
        self.0.resolution()
    }

    fn checks_per_node(&self) -> usize {
        self.0.checks_per_node()
    }
}

impl Verify for Corner {
    fn is_free_between(&self, a: &[f64], b: &[f64], t: f64) -> bool {
        self.0.is_free_between(a, b, t)
    }
}

#[test]
fn all_sources_grow_the_trees_of_brute_force_to_the_bit() {
    let (problem, server) = (small(), Server::start());
    let host = Host::new(Some(&server.uri)).unwrap();
    for seed in [1, 2] {
        let solve = |source| {
            let own = || TimedIndex::new(source, problem.space(), Some(&host)).unwrap();
            rrt::solve(&problem, [own(), own()], seed, 100_000).unwrap()
        };
        let expected = solve(Source::Brute);
        assert!(expected.trees.iter().all(|tree| tree.len() > 10));
        path::verify(&problem, &expected.path).unwrap();
        assert_eq!(expected.path.first().unwrap(), problem.start());
        assert_eq!(expected.path.last().unwrap(), problem.goal());
        for source in Source::All.sources() {
            let found = solve(source);
            assert!(found.trees == expected.trees, "{source:?}, seed {seed}");
            assert_eq!(found.path, expected.path);
        }
    }
}

#[test]
fn all_sources_grow_the_tree_of_rrt_star_of_brute_force_to_the_bit() {
    let (problem, server) = (Corner::new(), Server::start());
    let host = Host::new(Some(&server.uri)).unwrap();
    let grow = |source| {
        let own = TimedIndex::new(source, problem.space(), Some(&host)).unwrap();
        rrt_star::grow(&problem, own, 3, 3000).unwrap()
    };
    let expected = grow(Source::Brute);
    assert!(expected.tree.len() > 80);
    for source in Source::All.sources() {
        let found = grow(source);
        assert!(found.tree == expected.tree, "{source:?}");
        assert_eq!(found.goal, expected.goal);
    }
}

#[test]
fn the_way_of_rrt_star_only_becomes_shorter() {
    let problem = Corner::new();
    let grow = |samples| {
        let own = TimedIndex::new(Source::Memory, problem.space(), None).unwrap();
        rrt_star::grow(&problem, own, 3, samples).unwrap()
    };
    let mut costs = Vec::new();
    for samples in (2000..=12_000).step_by(2000) {
        let star = grow(samples);
        // The stored data of the nodes agrees with the states and parents.
        let tree = &star.tree;
        assert_eq!((tree.parents[0], tree.costs[0]), (None, 0.0));
        for node in 1..tree.len() {
            let parent = tree.parents[node].unwrap();
            let (from, to) = (tree.states.row(parent), tree.states.row(node));
            assert!((problem.space().distance(from, to) - tree.lengths[node]).abs() < 1e-12);
            assert_eq!(tree.costs[node], tree.costs[parent] + tree.lengths[node]);
            assert!(tree.costs[parent] < tree.costs[node], "no circles");
        }
        let Some(goal) = star.goal else {
            assert!(costs.is_empty() && star.shortened.is_empty());
            continue;
        };
        let path = tree.branch(goal);
        path::verify(&problem, &path).unwrap();
        assert_eq!(path.first().unwrap(), problem.start());
        assert_eq!(path.last().unwrap(), problem.goal());
        assert!((path::length(&problem, &path) - tree.costs[goal]).abs() < 1e-9);
        assert_eq!(star.progress.last().unwrap().cost, tree.costs[goal]);
        let lengths = star.shortened.iter().map(|&(_, length)| length);
        assert!(lengths.is_sorted_by(|before, after| before > after));
        assert_eq!(star.shortened.last().unwrap().1, tree.costs[goal]);
        costs.push(tree.costs[goal]);
    }
    assert!(costs.is_sorted_by(|before, after| before >= after));
    assert!(costs.first().unwrap() > costs.last().unwrap());
}

#[test]
fn all_sources_build_the_prm_star_roadmap_of_the_sampled_states() {
    let (problem, server) = (Corner::new(), Server::start());
    let host = Host::new(Some(&server.uri)).unwrap();
    let questions = [
        [problem.start(), problem.goal()],
        [problem.goal(), problem.start()],
    ];
    let milestones = 300;
    let solve = |source| {
        let own = TimedIndex::new(source, problem.space(), Some(&host)).unwrap();
        prm_star::solve(&problem, own, 4, milestones, &questions).unwrap()
    };
    let expected = solve(Source::Brute);
    let (roadmap, space) = (&expected.roadmap, problem.space());
    assert_eq!(roadmap.len(), milestones + 4);

    // The expected edges follow from all distances to earlier milestones, ties by number.
    for (n, state) in roadmap.states.iter().enumerate() {
        let distance = |other: usize| space.distance(state, roadmap.states.row(other));
        let mut near: Vec<usize> = (0..n).collect();
        near.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)).then(a.cmp(&b)));
        let k = 2.0 * std::f64::consts::E * (n as f64).ln();
        near.truncate(k.ceil().max(1.0) as usize);
        near.retain(|&other| problem.is_free_way(state, roadmap.states.row(other), &mut 0));
        near.sort_unstable();
        assert_eq!(roadmap.edges[n], near, "milestone {n}");
    }
    assert!(roadmap.edge_count() > 2 * milestones);

    for ([start, goal], path) in questions.iter().zip(&expected.paths) {
        let path = path.as_ref().unwrap();
        path::verify(&problem, path).unwrap();
        assert_eq!((&path[0][..], &path[path.len() - 1][..]), (*start, *goal));
    }
    for source in Source::All.sources() {
        let found = solve(source);
        assert!(found.roadmap == expected.roadmap, "{source:?}");
        assert_eq!(found.paths, expected.paths);
        assert_eq!(found.account.checks, expected.account.checks);
        assert_eq!(found.account.neighbors.searches, milestones + 4);
    }
}

fn two_local_sources() -> Trials<'static> {
    Trials {
        sources: vec![Source::Brute, Source::Scan],
        seeds: vec![1, 2, 3],
        server: None,
    }
}

#[test]
fn a_source_that_leads_to_another_roadmap_is_found_out() {
    let (problem, calls) = (Corner::new(), Cell::new(0));
    let compared = comparison::compare(&problem, &two_local_sources(), |own: &Open<'_>, seed| {
        calls.set(calls.get() + 1);
        // The scan of the second seed.
        let other = u64::from(calls.get() == 4);
        prm_star::solve(&problem, own()?, seed + 100 * other, 30, &[])
    });
    assert!(matches!(
        compared,
        Err(PlanningError::Differing { seed: 2, .. })
    ));
}

#[test]
fn a_comparison_tells_the_ratios_to_both_baselines() {
    let problem = Corner::new();
    let compared = comparison::compare(&problem, &two_local_sources(), |own: &Open<'_>, seed| {
        prm_star::solve(&problem, own()?, seed, 30, &[])
    });
    let compared = compared.unwrap();
    assert_eq!(compared.runs.len(), 6);
    let table = report::table(&compared, None);
    let lines: Vec<_> = table.lines().skip(2).take(2).collect();

    // The expected figures are computed from the rows, independently of the table.
    let rows: Vec<_> = compared.rows().collect();
    let median = |source: &str, of: fn(&RunTimes) -> f64| {
        let of_source = rows.iter().filter(|row| row.source == source);
        let mut times: Vec<f64> = of_source.map(|row| of(&row.spent)).collect();
        assert_eq!(times.len(), 3);
        times.sort_by(f64::total_cmp);
        times[1]
    };
    let neighbors =
        |source| median(source, |spent| spent.search_s) + median(source, |spent| spent.insert_s);
    let total = |source| median(source, |spent| spent.total_s);
    for (line, source) in lines.into_iter().zip(["brute", "scan"]) {
        assert!(line.starts_with(source));
        let shown = line.split_whitespace().rev().take(4);
        let shown = shown.map(|ratio| ratio.strip_suffix('×').unwrap().parse().unwrap());
        let [scan_total, scan_neighbors, brute_total, brute_neighbors]: [f64; 4] =
            shown.collect::<Vec<_>>().try_into().unwrap();
        for (shown, expected) in [
            (scan_total, total("scan") / total(source)),
            (scan_neighbors, neighbors("scan") / neighbors(source)),
            (brute_total, total("brute") / total(source)),
            (brute_neighbors, neighbors("brute") / neighbors(source)),
        ] {
            // The rounding errors of a ratio below ten and of one above.
            let rounding = if expected < 10.0 { 0.0051 } else { 0.51 };
            assert!(
                (shown - expected).abs() < rounding,
                "{line}: {shown}, {expected}"
            );
        }
    }
    for row in &rows {
        let RunTimes {
            total_s,
            search_s,
            insert_s,
            check_s,
            flush_s,
            busy_share,
        } = row.spent;
        assert_eq!(busy_share, None);
        assert!(search_s > 0.0 && insert_s > 0.0 && check_s > 0.0);
        assert!(search_s + insert_s + check_s <= total_s);
        assert!(flush_s < total_s);
    }
}

#[test]
fn all_sources_answer_all_searches_alike() {
    let (problem, server) = (small(), Server::start());
    let host = Host::new(Some(&server.uri)).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut draw = || sampling::uniform(problem.space(), problem.bounds(), &mut rng);
    let mut states = States::new(problem.space().coordinates());
    for _ in 0..300 {
        states.push(draw()).unwrap();
    }
    let queries: Vec<Vec<f64>> = (0..20).map(|_| draw()).collect();
    let answers = |source| -> Vec<Vec<Neighbor>> {
        let mut source = TimedIndex::new(source, problem.space(), Some(&host)).unwrap();
        assert_eq!(source.nearest(&queries[0]).unwrap(), None);
        source.insert(&states).unwrap();
        // More than all too.
        let each = [1, 7, 400].into_iter();
        let each = each.flat_map(|k| queries.iter().map(move |state| (state, k)));
        each.map(|(state, k)| source.nearest_k(state, k).unwrap())
            .collect()
    };
    let expected = answers(Source::Brute);
    for source in Source::All.sources() {
        assert_eq!(answers(source), expected, "{source:?}");
    }
}

#[test]
fn a_tree_that_may_not_grow_gives_up() {
    let problem = small();
    let own = || TimedIndex::new(Source::Memory, problem.space(), None).unwrap();
    let ended = rrt::solve(&problem, [own(), own()], 1, 50);
    assert!(matches!(ended, Err(PlanningError::Unsolved { nodes }) if nodes >= 50));
}
