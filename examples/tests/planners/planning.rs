//! The planners, in small: with every source of neighbours they grow the same trees, and what they find is
//! free by other code than theirs.

use std::cell::Cell;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::{Neighbor, Search, Space, States};
use wayfold_examples::{
    bodies::scene::Room,
    maze::scene::Maze,
    planning::{
        comparison::{self, Open, Trials},
        error::PlanningError,
        figures::Spent,
        options::Wanted,
        path::{self, Verify},
        prm_star,
        problem::Problem,
        remote::Remote,
        report, rrt, rrt_star, sampling,
    },
};

use crate::server::Server;

/// Two dead ends away from the start.
fn small() -> Maze {
    Maze::between((0, 0), (2, 3))
}

/// What is small, with no more of the maze to draw states from than it is about.
struct Corner(Maze, [(f64, f64); 2]);

impl Corner {
    fn new() -> Corner {
        Corner(small(), [(0.0, 3.0), (4.0, 8.0)])
    }
}

impl Problem for Corner {
    fn space(&self) -> &Space {
        self.0.space()
    }

    fn bounds(&self) -> &[(f64, f64)] {
        &self.1
    }

    fn start(&self) -> &[f64] {
        self.0.start()
    }

    fn goal(&self) -> &[f64] {
        self.0.goal()
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
    let remote = Remote::new(&server.uri).unwrap();
    for seed in [1, 2] {
        let solve = |source| {
            let own = || comparison::open(source, &problem, Some(&remote)).unwrap();
            rrt::solve(&problem, [own(), own()], seed, 100_000).unwrap()
        };
        let expected = solve(Wanted::Brute);
        assert!(expected.trees.iter().all(|tree| tree.len() > 10));
        path::verify(&problem, &expected.path).unwrap();
        assert_eq!(expected.path.first().unwrap(), problem.start());
        assert_eq!(expected.path.last().unwrap(), problem.goal());
        for source in Wanted::All.sources() {
            let found = solve(source);
            assert!(found.trees == expected.trees, "{source:?}, seed {seed}");
            assert_eq!(found.path, expected.path);
        }
    }
}

#[test]
fn all_sources_grow_the_tree_of_rrt_star_of_brute_force_to_the_bit() {
    let (problem, server) = (Corner::new(), Server::start());
    let remote = Remote::new(&server.uri).unwrap();
    let grow = |source| {
        let own = comparison::open(source, &problem, Some(&remote)).unwrap();
        rrt_star::grow(&problem, own, 3, 3000).unwrap()
    };
    let expected = grow(Wanted::Brute);
    assert!(expected.tree.len() > 80);
    for source in Wanted::All.sources() {
        let found = grow(source);
        assert!(found.tree == expected.tree, "{source:?}");
        assert_eq!(found.goal, expected.goal);
    }
}

#[test]
fn the_way_of_rrt_star_only_becomes_shorter() {
    let problem = Corner::new();
    let grow = |samples| {
        let own = comparison::open(Wanted::Forest, &problem, None).unwrap();
        rrt_star::grow(&problem, own, 3, samples).unwrap()
    };
    let mut costs = Vec::new();
    for samples in (2000..=12_000).step_by(2000) {
        let star = grow(samples);
        // What its nodes know is what the states and parents say.
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
fn all_sources_build_the_roadmap_of_prm_star_that_its_states_tell() {
    let (problem, server) = (Corner::new(), Server::start());
    let remote = Remote::new(&server.uri).unwrap();
    let questions = [
        [problem.start(), problem.goal()],
        [problem.goal(), problem.start()],
    ];
    let milestones = 300;
    let solve = |source| {
        let own = comparison::open(source, &problem, Some(&remote)).unwrap();
        prm_star::solve(&problem, own, 4, milestones, &questions).unwrap()
    };
    let expected = solve(Wanted::Brute);
    let (roadmap, space) = (&expected.roadmap, problem.space());
    assert_eq!(roadmap.len(), milestones + 4);

    // Each by all distances to those before it, the equally near by their numbers.
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
    for source in Wanted::All.sources() {
        let found = solve(source);
        assert!(found.roadmap == expected.roadmap, "{source:?}");
        assert_eq!(found.paths, expected.paths);
        assert_eq!(found.account.checks, expected.account.checks);
        assert_eq!(found.account.neighbors.searches, milestones + 4);
    }
}

fn two_local_sources() -> Trials<'static> {
    Trials {
        sources: vec![Wanted::Brute, Wanted::Scan],
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

    // From the rows, by other arithmetic than the table's.
    let rows: Vec<_> = compared.rows().collect();
    let median = |source: &str, of: fn(&Spent) -> f64| {
        let of_source = rows.iter().filter(|row| row.source == source);
        let mut times: Vec<f64> = of_source.map(|row| of(&row.spent)).collect();
        assert_eq!(times.len(), 3);
        times.sort_by(f64::total_cmp);
        times[1]
    };
    let neighbors =
        |source| median(source, |spent| spent.search_s) + median(source, |spent| spent.insert_s);
    let total = |source| median(source, |spent| spent.total_s);
    for (line, source) in lines.into_iter().zip(["brute force", "SIMD scan"]) {
        assert!(line.starts_with(source));
        let told = line.split_whitespace().rev().take(4);
        let told = told.map(|ratio| ratio.strip_suffix('×').unwrap().parse().unwrap());
        let [scan_total, scan_neighbors, brute_total, brute_neighbors]: [f64; 4] =
            told.collect::<Vec<_>>().try_into().unwrap();
        for (told, expected) in [
            (scan_total, total("SIMD scan") / total(source)),
            (scan_neighbors, neighbors("SIMD scan") / neighbors(source)),
            (brute_total, total("brute force") / total(source)),
            (
                brute_neighbors,
                neighbors("brute force") / neighbors(source),
            ),
        ] {
            // What rounding takes away, of a ratio below and of one above ten.
            let rounding = if expected < 10.0 { 0.0051 } else { 0.51 };
            assert!(
                (told - expected).abs() < rounding,
                "{line}: {told}, {expected}"
            );
        }
    }
    for row in &rows {
        let Spent {
            total_s,
            search_s,
            insert_s,
            check_s,
        } = row.spent;
        assert!(search_s > 0.0 && insert_s > 0.0 && check_s > 0.0);
        assert!(search_s + insert_s + check_s <= total_s);
    }
}

#[test]
fn all_sources_answer_all_searches_alike() {
    let (problem, server) = (small(), Server::start());
    let remote = Remote::new(&server.uri).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut draw = || sampling::uniform(problem.space(), problem.bounds(), &mut rng);
    let mut states = States::new(problem.space().coordinates());
    for _ in 0..300 {
        states.push(draw()).unwrap();
    }
    let asked: Vec<Vec<f64>> = (0..20).map(|_| draw()).collect();
    let both = Search {
        radius: 1.5,
        ..Search::nearest_k(9)
    };
    let answers = |source| -> Vec<Vec<Neighbor>> {
        let mut source = comparison::open(source, &problem, Some(&remote)).unwrap();
        assert_eq!(source.nearest(&asked[0]).unwrap(), None);
        source.insert(&states).unwrap();
        let searches = [Search::nearest_k(1), Search::nearest_k(7), both];
        let searches = searches.into_iter().chain([Search::nearest_r(1.0)]);
        let each = searches.flat_map(|search| asked.iter().map(move |state| (state, search)));
        each.map(|(state, search)| source.search(state, &search).unwrap())
            .collect()
    };
    let expected = answers(Wanted::Brute);
    for source in Wanted::All.sources() {
        assert_eq!(answers(source), expected, "{source:?}");
    }
}

#[test]
fn a_tree_that_may_not_grow_gives_up() {
    let problem = small();
    let own = || comparison::open(Wanted::Forest, &problem, None).unwrap();
    let ended = rrt::solve(&problem, [own(), own()], 1, 50);
    assert!(matches!(ended, Err(PlanningError::Unsolved { nodes }) if nodes >= 50));
}

#[test]
fn a_path_through_a_wall_is_found_out() {
    let problem = Maze::new();
    let through = [problem.start().to_vec(), problem.goal().to_vec()];
    let found = path::verify(&problem, &through);
    assert!(matches!(
        found,
        Err(PlanningError::Collision { segment: 0 })
    ));
}

/// Whether the finer check takes a state for free.
fn is_free_by_other_code(problem: &impl Verify, state: &[f64]) -> bool {
    problem.is_free_between(state, state, 0.0)
}

#[test]
fn the_finer_check_of_the_maze_tells_a_touch_from_a_gap() {
    let problem = Maze::new();
    // The left wall reaches to 0.05, the body 0.33 from its middle.
    assert!(!is_free_by_other_code(&problem, &[0.38, 7.5, 0.0]));
    assert!(is_free_by_other_code(&problem, &[0.381, 7.5, 0.0]));
    // The planner keeps a margin.
    assert!(!problem.is_free(&[0.381, 7.5, 0.0]));
    // On a corner it is 0.467 to each side, more than the corridor has.
    let turned = std::f64::consts::FRAC_PI_4;
    assert!(!is_free_by_other_code(&problem, &[0.5, 7.5, turned]));
    assert!(is_free_by_other_code(&problem, &[0.5, 7.5, 0.0]));
}

#[test]
fn the_finer_check_of_the_room_tells_a_touch_from_a_gap() {
    let problem = Room::new();
    let with = |body: usize, place: [f64; 3]| {
        let mut state = problem.start().to_vec();
        state[7 * body..7 * body + 3].copy_from_slice(&place);
        is_free_by_other_code(&problem, &state)
    };
    // Two upright bodies, each 0.1 deep to both sides; the first is where it starts.
    assert!(!with(1, [1.2, 1.4 + 0.2, 1.3]));
    assert!(with(1, [1.2, 1.4 + 0.201, 1.3]));
    // A pillar begins at 4.0, and the upper bar reaches 0.4 to its side.
    assert!(!with(0, [3.6, 0.5, 3.0]));
    assert!(with(0, [3.599, 0.5, 3.0]));
    // The lower bar reaches 0.41 down to the floor, and the upper one 0.41 up to the ceiling.
    assert!(!with(0, [1.2, 1.4, 0.409]) && with(0, [1.2, 1.4, 0.411]));
    assert!(!with(0, [1.2, 1.4, 5.591]) && with(0, [1.2, 1.4, 5.589]));
}

/// Whatever the planner takes for free is free, and so is all that is within half a resolution of it.
fn free_is_free(problem: &impl Verify, states: usize) {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let (space, mut free) = (problem.space(), 0);
    let mut moved = vec![0.0; space.coordinates()];
    for _ in 0..states {
        let state = sampling::uniform(space, problem.bounds(), &mut rng);
        if !problem.is_free(&state) {
            continue;
        }
        free += 1;
        assert!(problem.is_free_between(&state, &state, 0.0));
        let far = sampling::uniform(space, problem.bounds(), &mut rng);
        let share = 0.5 * problem.resolution() / space.distance(&state, &far);
        space.interpolate(&state, &far, share * rng.random::<f64>().sqrt(), &mut moved);
        assert!(problem.is_free_between(&moved, &moved, 0.0));
    }
    assert!((states / 1000..states).contains(&free), "{free}");
}

#[test]
fn what_is_free_in_the_maze_is_free_with_its_surroundings() {
    let problem = small();
    assert!(problem.is_free(problem.start()) && problem.is_free(problem.goal()));
    free_is_free(&problem, 20_000);
}

#[test]
fn what_is_free_in_the_room_is_free_with_its_surroundings() {
    let problem = Room::new();
    assert!(problem.is_free(problem.start()) && problem.is_free(problem.goal()));
    // The second body in the place of the first.
    let mut two = problem.start().to_vec();
    two.copy_within(0..7, 7);
    assert!(!problem.is_free(&two) && !problem.is_free_between(&two, &two, 0.0));
    free_is_free(&problem, 3000);
}
