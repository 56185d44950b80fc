//! Numbers and radii by the size of the index: from the server, from a replica, and from brute force.

use wayfold::{NeighborQuery, Neighbors, Scaling, Space};
use wayfold_index::{Linear, PointRef, Search};

use crate::{fake::Fake, server::Server};

const SPACE: &str = "R2*SO2";

fn rows(start: usize, count: usize) -> Vec<[f64; 3]> {
    let number = |at: usize| (at as f64 * 0.754_877_666_246_693).fract();
    let row = |row: usize| [3 * row, 3 * row + 1, 3 * row + 2].map(number);
    (start..start + count).map(row).collect()
}

fn k_scaled(k_factor: f64) -> Scaling {
    Scaling {
        k_factor: Some(k_factor),
        ..Scaling::default()
    }
}

#[cfg(feature = "replica")]
fn radius_scaled(radius_factor: f64, radius_max: Option<f64>) -> Scaling {
    Scaling {
        radius_factor: Some(radius_factor),
        radius_max,
        ..Scaling::default()
    }
}

/// r(n) in three dimensions.
fn radius(factor: f64, n: usize) -> f64 {
    factor * ((n as f64).ln() / n as f64).cbrt()
}

fn expect(found: &Neighbors, row: usize, points: &Linear, state: &[f64], search: &Search<'_>) {
    let expected = points.search(state, search).unwrap().neighbors;
    let expected: Vec<(u64, f64)> = expected.iter().map(|n| (n.id, n.distance)).collect();
    let found: Vec<(u64, f64)> = found.row(row).iter().collect();
    assert_eq!(found, expected, "{state:?} {search:?}");
}

#[tokio::test]
async fn the_server_evaluates_it_at_the_size_of_its_index() {
    let server = Server::start();
    let index = server.index("se2", SPACE).await;
    let mut points = Linear::new(SPACE.parse::<Space>().unwrap());
    let mut insert = |id: usize, row: &[f64; 3]| {
        points
            .insert(PointRef {
                id: id as u64,
                tag: 0,
                revision: 1,
                row,
            })
            .unwrap();
        points.clone()
    };

    // Each row of an insert counts those before it: k(n) is 1 for none and for one.
    let stored = rows(0, 200);
    let around = NeighborQuery {
        scaling: k_scaled(Scaling::K_FACTOR),
        ..NeighborQuery::default()
    };
    let inserted = index.insert(&stored).neighbors(around).await.unwrap();
    let neighbors = inserted.neighbors.unwrap();
    assert_eq!((neighbors.row(0).len(), neighbors.row(1).len()), (0, 1));
    let mut before = Linear::new(SPACE.parse::<Space>().unwrap());
    for (n, row) in stored.iter().enumerate() {
        let k = (2.0 * std::f64::consts::E * (n as f64).ln()).ceil() as usize;
        expect(&neighbors, n, &before, row, &Search::nearest_k(k.max(1)));
        before = insert(n, row);
    }
    let points = before;

    let asked = rows(500, 10);
    let by_k = index.knn(&asked).k_scaled(2.0).radius(0.4).await.unwrap();
    let by_radius = index
        .knn(&asked)
        .k(7)
        .radius_scaled(1.1, Some(0.9))
        .await
        .unwrap();
    let all = index.query(&asked, 0.9).radius_scaled(1.1).await.unwrap();
    let bounded = index.query(&asked, 0.1).radius_scaled(1.1).await.unwrap();
    // Whichever was said last.
    let fixed = index
        .knn(&asked)
        .k_scaled(2.0)
        .k(3)
        .radius_scaled(1.1, None)
        .radius(0.5);
    let fixed = fixed.await.unwrap();
    for (at, state) in asked.iter().enumerate() {
        let within = |k, radius| Search {
            radius,
            ..Search::nearest_k(k)
        };
        // 2 · ln 200 = 10.6
        expect(&by_k, at, &points, state, &within(11, 0.4));
        let scaled = radius(1.1, 200);
        expect(&by_radius, at, &points, state, &within(7, scaled));
        expect(&all, at, &points, state, &within(usize::MAX, scaled));
        expect(&bounded, at, &points, state, &within(usize::MAX, 0.1));
        expect(&fixed, at, &points, state, &within(3, 0.5));
    }
}

#[cfg(feature = "replica")]
#[tokio::test]
async fn a_replica_answers_and_refuses_as_the_server() {
    use wayfold::{Error, Filter};

    let server = Server::start();
    let index = server.index("se2", SPACE).await;
    index.insert(rows(0, 100)).await.unwrap();
    let inserted = index.insert(rows(100, 50)).await.unwrap();
    let replica = server.client().await.replica("se2").await.unwrap();
    let [state] = rows(700, 1)[..] else {
        panic!("one row")
    };
    let new = Filter {
        since_revision: inserted.revision - 1,
        ..Filter::default()
    };
    for filter in [Filter::default(), new] {
        let search = Search {
            filter,
            ..Search::nearest_r(0.6)
        };
        let ours = replica
            .search_scaled(state, k_scaled(3.0), &search)
            .unwrap();
        let theirs = index.knn([state]).k_scaled(3.0).radius(0.6).filter(filter);
        let theirs = theirs.await.unwrap();
        let ours: Vec<(u64, f64)> = ours.neighbors.iter().map(|n| (n.id, n.distance)).collect();
        assert_eq!(ours, theirs.row(0).iter().collect::<Vec<_>>());
        // 3 · ln 150 = 15.03, with the points that the filter leaves out.
        assert!(ours.len() <= 16);
    }
    let everything = Search::nearest_k(usize::MAX);
    let scaling = radius_scaled(1.2, Some(f64::INFINITY));
    let ours = replica.search_scaled(state, scaling, &everything).unwrap();
    let theirs = index.query([state], f64::INFINITY).radius_scaled(1.2);
    let theirs = theirs.await.unwrap();
    let ids: Vec<u64> = ours.neighbors.iter().map(|n| n.id).collect();
    assert_eq!(ids, theirs.row(0).ids);
    assert!(ids.len() > 1 && ids.len() < 150);

    for scaling in [
        k_scaled(-1.0),
        k_scaled(f64::NAN),
        radius_scaled(f64::INFINITY, None),
        radius_scaled(1.0, Some(-1.0)),
        Scaling {
            radius_max: Some(1.0),
            ..k_scaled(1.0)
        },
    ] {
        let ours = replica.search_scaled(state, scaling, &everything);
        let around = NeighborQuery {
            scaling,
            ..NeighborQuery::default()
        };
        let theirs = index.insert([state]).neighbors(around).await;
        let (Error::Refused(theirs), Error::Refused(ours)) =
            (theirs.unwrap_err(), ours.unwrap_err())
        else {
            panic!("{scaling:?}")
        };
        let of_theirs = theirs.fields[0].field.replace("neighbors.", "");
        assert_eq!(
            (ours.code, &ours.reason, &ours.fields[0].field),
            (theirs.code, &theirs.reason, &of_theirs)
        );
    }
}

#[tokio::test]
async fn rows_are_divided_for_the_largest_index_that_there_may_be() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    let states: Vec<[f64; 1]> = (0..2500).map(|x| [f64::from(x)]).collect();
    let around = NeighborQuery {
        scaling: k_scaled(Scaling::K_FACTOR),
        ..NeighborQuery::default()
    };
    index.insert(&states).neighbors(around).await.unwrap();
    let sent = fake.insert_requests();
    let rows: Vec<u32> = sent
        .iter()
        .map(|one| one.states.as_ref().unwrap().rows)
        .collect();
    // 2e · ln 2^32 = 120.6: 121 neighbours of 16 bytes, and 16 bytes more.
    assert_eq!(rows, [2148, 352]);
}
