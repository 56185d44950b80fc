//! Every structure refuses points and searches that do not fit the space, with a typed error and without a change.

use wayfold_index::{
    ApplyError, Forest, ForestOptions, KdTree, Linear, Mpnn, PointRef, Points, PointsError, Search,
    SearchError, Space, StateProblem,
};

/// Rows that are no canonical states of `R2*SO2*SO3`, with the coordinate to blame.
fn bad_rows() -> Vec<(Vec<f64>, usize, StateProblem)> {
    let row = |axis: usize, x: f64| {
        let mut row = good_row();
        row[axis] = x;
        row
    };
    let negated: Vec<f64> = good_row().iter().map(|x| 0.0 - x).collect();
    vec![
        (row(1, f64::NAN), 1, StateProblem::NaN),
        (row(0, f64::NEG_INFINITY), 0, StateProblem::Infinite),
        (row(1, 2e150), 1, StateProblem::TooLarge),
        (row(1, -0.0), 1, StateProblem::NotCanonical),
        (row(2, 4.0), 2, StateProblem::NotCanonical),
        (row(2, std::f64::consts::PI), 2, StateProblem::NotCanonical),
        (row(2, f64::NAN), 2, StateProblem::NaN),
        (row(3, -0.0), 3, StateProblem::NotCanonical),
        (row(4, f64::INFINITY), 4, StateProblem::Infinite),
        (row(6, 0.805), 5, StateProblem::NotCanonical),
        (
            row(6, 1.8),
            3,
            StateProblem::Norm((0.6f64 * 0.6 + 1.8 * 1.8).sqrt()),
        ),
        (negated, 5, StateProblem::NotCanonical),
    ]
}

fn good_row() -> Vec<f64> {
    vec![0.0, 0.0, 0.0, 0.0, 0.0, 0.6, 0.8]
}

fn space() -> Space {
    "R2*SO2*SO3".parse().unwrap()
}

fn points(rows: &[(u64, &[f64])]) -> Points {
    let mut points = Points::new(rows[0].1.len());
    for (id, row) in rows {
        points.push(*id, 0, 1, row);
    }
    points
}

#[test]
fn rows_that_are_not_canonical_states_are_not_stored() {
    let mut forest = Forest::new(space(), ForestOptions::for_space(&space()));
    let mut linear = Linear::new(space());
    let good = good_row();
    for (bad, coordinate, reason) in bad_rows() {
        // Few rows are checked one by one, and more at once.
        for (rows, at) in [(2, 1), (21, 0), (21, 7), (21, 8), (21, 20)] {
            let row = |id| if id == at { &bad[..] } else { &good };
            let stored = points(&(0..rows).map(|id| (id, row(id))).collect::<Vec<_>>());
            let is_expected = |error: &PointsError| match error {
                PointsError::State { row, error } => {
                    *row as u64 == at && error.coordinate == coordinate && error.reason == reason
                }
                _ => false,
            };
            let error = KdTree::new(space(), stored.clone(), 8).unwrap_err();
            assert!(is_expected(&error), "{bad:?} {error}");
            let error = Mpnn::new(space(), stored.clone(), 8).unwrap_err();
            assert!(is_expected(&error), "{bad:?} {error}");
            match forest.apply(1, &stored, &[]) {
                Err(ApplyError::Points(error)) => assert!(is_expected(&error), "{bad:?} {error}"),
                other => panic!("{bad:?} {other:?}"),
            }
        }
        let point = PointRef {
            id: 2,
            tag: 0,
            revision: 1,
            row: &bad,
        };
        let error = linear.insert(point).unwrap_err();
        assert_eq!((error.coordinate, error.reason), (coordinate, reason));
    }
    assert!(forest.is_empty() && forest.revision() == 0 && linear.is_empty());
    forest.validate().unwrap();
}

#[test]
fn tables_of_another_width_are_not_stored() {
    let narrow = points(&[(1, &[0.0; 3])]);
    let expected = PointsError::Width {
        expected: 7,
        found: 3,
    };
    let error = KdTree::new(space(), narrow.clone(), 8).unwrap_err();
    assert_eq!(error, expected);
    let mut forest = Forest::new(space(), ForestOptions::for_space(&space()));
    let error = forest.apply(1, &narrow, &[]).unwrap_err();
    assert_eq!(error, ApplyError::Points(expected));
    let error = Linear::new(space()).insert(narrow.get(0)).unwrap_err();
    let (expected, found) = (7, 3);
    assert_eq!(error.reason, StateProblem::Width { expected, found });
}

#[test]
fn an_id_is_stored_once_in_a_mutation() {
    let row = good_row();
    for ids in [[3, 3, 5, 7], [9, 3, 5, 3]] {
        let twice = points(&ids.map(|id| (id, &row[..])));
        let error = KdTree::new(space(), twice.clone(), 8).unwrap_err();
        assert_eq!(error, PointsError::DuplicateId(3));
        let mut forest = Forest::new(space(), ForestOptions::for_space(&space()));
        let error = forest.apply(1, &twice, &[]).unwrap_err();
        assert_eq!(error, ApplyError::Points(PointsError::DuplicateId(3)));
        assert!(forest.is_empty());
        // A removed point may be stored again, and an id may be removed twice.
        forest.apply(1, &points(&[(3, &row)]), &[]).unwrap();
        assert_eq!(forest.apply(2, &points(&[(3, &row)]), &[3, 3]), Ok(1));
        assert_eq!(forest.len(), 1);
        forest.validate().unwrap();
    }
}

#[test]
fn a_stored_id_is_not_loaded_again() {
    let row = good_row();
    let mut forest = Forest::new(space(), ForestOptions::for_space(&space()));
    forest.load(&points(&[(3, &row), (5, &row)])).unwrap();
    let error = forest.load(&points(&[(7, &row), (5, &row)])).unwrap_err();
    assert_eq!(error, ApplyError::Points(PointsError::DuplicateId(5)));
    assert_eq!(forest.len(), 2);
    // An id that was removed is free again.
    forest.apply(1, &Points::new(7), &[5]).unwrap();
    forest.load(&points(&[(5, &row)])).unwrap();
    assert_eq!(forest.len(), 2);
    forest.validate().unwrap();
}

#[test]
fn a_revision_is_applied_once() {
    let mut forest = Forest::new(space(), ForestOptions::for_space(&space()));
    forest.apply(5, &Points::new(7), &[]).unwrap();
    for revision in [0, 4, 5, u64::MAX] {
        let error = forest.apply(revision, &points(&[(1, &good_row())]), &[]);
        assert_eq!(error, Err(ApplyError::Revision { revision, head: 5 }));
    }
    assert!(forest.is_empty());
}

#[test]
fn a_leaf_reserves_no_more_than_the_points_that_there_are() {
    let row = good_row();
    for leaf_rows in [1 << 40, usize::MAX / 2, usize::MAX] {
        let tree = KdTree::new(space(), points(&[(1, &row), (2, &row)]), leaf_rows).unwrap();
        let found = tree.search(&row, &Search::nearest_k(5)).unwrap();
        assert_eq!(found.neighbors.len(), 2);
    }
}

#[test]
fn searches_for_no_state_or_out_of_range_are_not_answered() {
    let stored = points(&[(1, &good_row())]);
    let tree = KdTree::new(space(), stored.clone(), 8).unwrap();
    let binary = Mpnn::new(space(), stored.clone(), 8).unwrap();
    let mut forest = Forest::new(space(), ForestOptions::for_space(&space()));
    forest.apply(1, &stored, &[]).unwrap();
    let mut linear = Linear::new(space());
    linear.insert(stored.get(0)).unwrap();
    let check = |state: &[f64], search: &Search<'_>, is_expected: &dyn Fn(&SearchError) -> bool| {
        for answer in [
            tree.search(state, search),
            forest.search(state, search),
            forest.snapshot().search(state, search),
            binary.search(state, search),
            linear.search(state, search),
        ] {
            let error = answer.unwrap_err();
            assert!(is_expected(&error), "{state:?} {error}");
        }
    };
    let nearest = Search::nearest_k(1);
    for (bad, coordinate, reason) in bad_rows() {
        check(&bad, &nearest, &|error| match error {
            SearchError::State(error) => error.coordinate == coordinate && error.reason == reason,
            _ => false,
        });
    }
    for width in [0, 6, 8] {
        let state = vec![0.0; width];
        check(&state, &nearest, &|error| {
            matches!(
                error,
                SearchError::State(error) if matches!(error.reason, StateProblem::Width { .. })
            )
        });
    }
    let radius = Search::nearest_r(f64::NAN);
    check(&good_row(), &radius, &|error| *error == SearchError::Radius);
    for epsilon in [-0.1, f64::NAN, f64::INFINITY] {
        let search = Search { epsilon, ..nearest };
        check(&good_row(), &search, &|error| {
            matches!(error, SearchError::Epsilon(_))
        });
    }
    assert_eq!(
        forest.search(&good_row(), &nearest).unwrap().neighbors[0].id,
        1
    );
}
