//! Answers after a reload, and to searches that are scaled.

use wayfold_index::{Forest, ForestOptions, Points, ScaledSearch, Scaling};

use super::*;

/// The neighbours after a reload of a point 0, whose insert found `found`. The other points are ids, tags and places.
fn superset(
    search: &Search<'_>,
    found: &[Neighbor],
    others: impl Iterator<Item = (u64, u64, f64)>,
) -> Vec<u64> {
    let mut open = OpenSearch::new((0, 0), &[0.0], &(*search).into(), found, 1);
    open.reload(1);
    open.search_all();
    // Others may have stored points after it.
    open.revision = None;
    let answerable = Answerable {
        searches: vec![open],
        points: HashMap::new(),
        later: HashSet::new(),
        departure: 0,
        snapshot: Some(snapshot(others)),
    };
    let answer = answerable.answers(&space()).next().unwrap();
    assert!(answer.is_superset);
    ids(&answer.neighbors)
}

fn space() -> Space {
    "R1".parse().unwrap()
}

/// The point 0 at 0, and others: ids, tags and places.
fn snapshot(others: impl Iterator<Item = (u64, u64, f64)>) -> ForestSnapshot {
    let mut points = Points::new(1);
    for (id, tag, x) in others.chain([(0, 1, 0.0)]) {
        points.push(id, tag, 1, &[x]);
    }
    let mut forest = Forest::new(space(), ForestOptions::for_space(&space()));
    forest.apply(1, &points, &[]).unwrap();
    forest.snapshot()
}

fn ids(neighbors: &[Neighbor]) -> Vec<u64> {
    neighbors.iter().map(|neighbor| neighbor.id).collect()
}

const NEAREST: Neighbor = Neighbor {
    distance: 1.0,
    id: 1,
};

/// The insert found the point 1 at distance 1. While the copy was read again, the point stayed, left, moved or lost
/// its tag; the point 2, at distance 3, is the nearest neighbour then.
#[test]
fn a_reload_misses_no_neighbour_in_place_of_one_that_left() {
    let mut search = Search::nearest_k(1);
    (search.filter.tag_mask, search.filter.tag_value) = (1, 1);
    let answer = |first: Option<(u64, f64)>| {
        let first = first.map(|(tag, x)| (1, tag, x));
        superset(&search, &[NEAREST], first.into_iter().chain([(2, 1, 3.0)]))
    };
    assert_eq!(answer(Some((1, 1.0))), [1]);
    assert_eq!(answer(None), [2]);
    assert_eq!(answer(Some((1, 5.0))), [2, 1]);
    assert_eq!(answer(Some((0, 1.0))), [2]);
}

/// The copy had fewer points than the search asked for.
#[test]
fn a_superset_without_a_bound_has_a_limit() {
    let count = MAX_SUPERSET as u64 + 10;
    let others = (1..=count).map(|id| (id, 0, id as f64));
    let found = superset(&Search::nearest_k(2), &[NEAREST], others);
    // One of them is the point itself.
    assert!(found.iter().copied().eq(1..MAX_SUPERSET as u64));
}

/// The answers about a point 0 at 0, whose search is scaled. The copy had the points 1 to `old` at these places, and
/// others stored those after them until it had `points_before` points before it. Returns the ids that the insert
/// answered, those that it did not, and whether these are a superset.
fn scaled(
    scaling: Scaling,
    places: &[f64],
    old: usize,
    points_before: usize,
) -> (Vec<u64>, Vec<u64>, bool) {
    let search = Search::nearest_k(usize::MAX);
    let search = InsertSearch::new(&ScaledSearch { search, scaling }, old, 1);
    let stored = (1..).zip(places).map(|(id, &x)| (id, 0, x));
    let copy = snapshot(stored.clone().take(old));
    // The copy here has the point 0 already, which takes a place.
    let asked = Search {
        k: search.search.k.saturating_add(1),
        ..search.search
    };
    let mut found = copy.search(&[0.0], &asked).unwrap().neighbors;
    found.retain(|neighbor| neighbor.id != 0);
    let mut open = OpenSearch::new((0, 0), &[0.0], &search, &found, 1);
    open.points_before = points_before;
    let mut searches = OpenSearches::default();
    searches.open();
    for (id, _, _) in stored.clone().skip(old) {
        searches.push(id + 1, id, Difference::plain(None));
    }
    let content = |id: u64| vec![(usize::MAX, Some((0, vec![places[id as usize - 1]])))];
    let answerable = searches.answerable(
        &space(),
        vec![open],
        || [0].into(),
        None,
        content,
        || snapshot(stored),
    );
    let answerable = answerable.unwrap();
    let answer = answerable.answers(&space()).next().unwrap();
    found.truncate(search.answer_len(&found));
    (ids(&found), ids(&answer.neighbors), answer.is_superset)
}

/// By hand: k(6) = ⌈2 ln 6⌉ = ⌈3.58⌉, and k(13) = ⌈5.13⌉.
#[test]
fn a_number_that_grows_until_the_place_misses_no_neighbour() {
    let scaling = Scaling {
        k_factor: Some(2.0),
        ..Scaling::default()
    };
    let mut places = vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 4.5];
    places.extend([20.0; 6]);
    let (answered, told, is_superset) = scaled(scaling, &places, 6, 13);
    assert_eq!(answered, [1, 2, 3, 4]);
    // The six nearest are these four, the point 7, which arrived beyond them, and the older point 5.
    assert_eq!(told, [7, 5, 6]);
    assert!(!is_superset);
    // Without arrivals the number stays, and the older point 5 is no neighbour.
    let (answered, told, _) = scaled(scaling, &places[..6], 6, 6);
    assert!(answered.len() == 4 && told.is_empty(), "{told:?}");
}

/// By hand: the insert searches for k(2 · 20 + 4,096) = ⌈16.7⌉ neighbours, and k(100,000) = ⌈23.03⌉.
#[test]
fn a_number_that_grows_beyond_the_reserve_makes_a_superset() {
    let scaling = Scaling {
        k_factor: Some(2.0),
        ..Scaling::default()
    };
    let places: Vec<f64> = (1..=100).map(f64::from).collect();
    let (answered, told, is_superset) = scaled(scaling, &places, 20, 100_000);
    assert_eq!(answered, [1, 2, 3, 4, 5, 6]);
    assert!((1..=24).all(|id| told.contains(&id)), "{told:?}");
    assert!(is_superset && told.len() < 30, "{told:?}");
}

/// By hand: r(2) = ln 2 / 2 = 0.347, and r(3) = ln 3 / 3 = 0.366.
#[test]
fn a_radius_that_grows_until_the_place_misses_no_neighbour() {
    let scaling = Scaling {
        radius_factor: Some(1.0),
        ..Scaling::default()
    };
    let (answered, told, is_superset) = scaled(scaling, &[0.2, 0.36, 0.365], 2, 3);
    assert_eq!((answered, told, is_superset), (vec![1], vec![2, 3], false));
    // From three points on it shrinks: r(4) is r(2).
    assert_eq!(scaled(scaling, &[0.2, 0.36, 0.35, 0.34], 3, 4).1, [4]);
}
