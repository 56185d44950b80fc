//! The client library against a real server: what it divides, remembers and pipelines.

use tokio::task::JoinSet;
use wayfold::{Client, Knn, NeighborSpec, Outcome, READ_ROWS};
use wayfold_index::{Linear, Search, Space};
use wayfold_tests::{
    States,
    brute_force::{self, pairs},
    server,
};

const WIDTH: usize = 7;

fn brute_force(ids: &[u64], rows: &[f64]) -> Linear {
    let mut points = Linear::new(Space::se3());
    brute_force::store(&mut points, ids, rows, 0, 1);
    points
}

#[tokio::test]
async fn what_exceeds_one_call_is_divided_and_joined() {
    let server = server!();
    let client = Client::connect(server.uri()).await.unwrap();
    let roadmap = client.create_index("arm", &Space::se3()).await.unwrap();
    let mut states = States::new(Space::se3(), 23);
    // More rows than a call may have, and more bytes than a message.
    let limits = client.server().await.unwrap().limits;
    let rows = states.rows(limits.rows_per_call + 500);
    assert!(8 * rows.len() < 2 * limits.request_bytes);
    let ids: Vec<u64> = (0..(rows.len() / WIDTH) as u64).collect();
    let inserted = roadmap
        .insert(rows.chunks(WIDTH))
        .ids(ids.clone())
        .await
        .unwrap();
    assert_eq!(inserted.outcomes.len(), ids.len());
    assert_eq!(roadmap.info().await.unwrap().point_count, ids.len() as u64);

    let points = brute_force(&ids, &rows);
    let asked = states.rows(READ_ROWS + 200);
    let answer = roadmap.knn(asked.chunks(WIDTH)).k(3).await.unwrap();
    assert_eq!(answer.len(), READ_ROWS + 200);
    for (row, state) in answer.rows().zip(asked.chunks(WIDTH)) {
        let expected = brute_force::search(&points, state, &Search::nearest_k(3));
        assert_eq!(pairs(row.iter()), expected);
    }
}

#[tokio::test]
async fn a_stream_answers_in_order() {
    let server = server!();
    let client = Client::connect(server.uri()).await.unwrap();
    let roadmap = client.create_index("arm", &Space::se3()).await.unwrap();
    let mut states = States::new(Space::se3(), 29);
    let rows = states.rows(1_000);
    let ids: Vec<u64> = (0..1_000).collect();
    roadmap
        .insert(rows.chunks(WIDTH))
        .ids(ids.clone())
        .await
        .unwrap();

    let points = brute_force(&ids, &rows);
    let asked = states.rows(300);
    let requests: Vec<Knn> = asked
        .chunks(WIDTH)
        .map(|state| roadmap.knn([state]).k(5))
        .collect();
    let (mut requests_to, mut answers) = roadmap.stream_knn().await.unwrap();
    let sending = tokio::spawn(async move {
        for request in requests {
            requests_to.send(request).await.unwrap();
        }
    });
    for state in asked.chunks(WIDTH) {
        let answer = answers.next().await.unwrap().unwrap();
        let expected = brute_force::search(&points, state, &Search::nearest_k(5));
        assert_eq!(pairs(answer.row(0).iter()), expected);
    }
    sending.await.unwrap();
    assert_eq!(answers.next().await.unwrap(), None);
}

#[tokio::test(flavor = "multi_thread")]
async fn planners_read_what_they_wrote() {
    let server = server!();
    let mut planners = JoinSet::new();
    for seed in 0..6 {
        let uri = server.uri().to_owned();
        planners.spawn(async move {
            let client = Client::connect(&uri).await.unwrap();
            let roadmap = client.create_index("arm", &Space::se3()).await.unwrap();
            let mut states = States::new(Space::se3(), seed);
            for _ in 0..50 {
                let row = states.row();
                let around = NeighborSpec::k(4);
                let inserted = roadmap.insert([&row[..]]).neighbors(around).await.unwrap();
                let Outcome::Inserted { id } = inserted.outcomes[0] else {
                    panic!("{inserted:?}");
                };
                // On whichever revision the read sees, the point is there, and nothing is nearer to itself.
                let found = roadmap.knn([&row[..]]).k(1).await.unwrap();
                let itself = found.row(0).nearest().unwrap();
                assert_eq!((itself.id, itself.distance), (id, 0.0));
                assert!(found.revision().number >= inserted.revision.number);
                let around = inserted.neighbors.unwrap();
                assert!(!around.row(0).ids.contains(&id), "its own neighbour");
            }
        });
    }
    planners.join_all().await;
}
