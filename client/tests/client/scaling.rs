//! Numbers and radii by the size of the index: from the server, and from brute force.

use wayfold::{NeighborSpec, Neighbors, ScaledRadius, Scaling, Space};
use wayfold_index::{Linear, Neighbor, PointRef, Search};

use crate::{fake::Fake, server::Server};

pub(crate) const SPACE: &str = "R2*SO2";

pub(crate) fn rows(start: usize, count: usize) -> Vec<[f64; 3]> {
    let number = |at: usize| (at as f64 * 0.754_877_666_246_693).fract();
    let row = |row: usize| [3 * row, 3 * row + 1, 3 * row + 2].map(number);
    (start..start + count).map(row).collect()
}

/// r(n) in three dimensions.
fn radius(factor: f64, n: usize) -> f64 {
    factor * ((n as f64).ln() / n as f64).cbrt()
}

fn expect(found: &Neighbors, row: usize, points: &Linear, state: &[f64], search: &Search<'_>) {
    let expected = points.search(state, search).unwrap().neighbors;
    let found: Vec<Neighbor> = found.row(row).iter().collect();
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
    let around = NeighborSpec::k_factor(Scaling::K_FACTOR);
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

    let queries = rows(500, 10);
    let by_k = index.knn(&queries).k_factor(2.0).radius(0.4).await.unwrap();
    let by_radius = index
        .knn(&queries)
        .k(7)
        .radius(ScaledRadius::new(1.1).max(0.9))
        .await
        .unwrap();
    let scaled_to = |max| ScaledRadius::new(1.1).max(max);
    let all = index.query(&queries, scaled_to(0.9)).await.unwrap();
    let bounded = index.query(&queries, scaled_to(0.1)).await.unwrap();
    // The last setting counts.
    let fixed = index
        .knn(&queries)
        .k_factor(2.0)
        .k(3)
        .radius(ScaledRadius::new(1.1))
        .radius(0.5);
    let fixed = fixed.await.unwrap();
    for (at, state) in queries.iter().enumerate() {
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

#[tokio::test]
async fn rows_are_divided_for_the_largest_index_that_there_may_be() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    let states: Vec<[f64; 1]> = (0..2500).map(|x| [f64::from(x)]).collect();
    let around = NeighborSpec::k_factor(Scaling::K_FACTOR);
    index.insert(&states).neighbors(around).await.unwrap();
    let sent = fake.insert_requests();
    let rows: Vec<u32> = sent
        .iter()
        .map(|one| one.states.as_ref().unwrap().row_count)
        .collect();
    // 2e · ln 2^32 = 120.6: 121 neighbours of 16 bytes, and 16 bytes more.
    assert_eq!(rows, [2148, 352]);
}
