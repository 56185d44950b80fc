//! The client divides a request that exceeds the bounds of one call, in order, and joins the answers.

use tonic::Status;
use wayfold::{
    Client, Code, Durability, Error, Include, NeighborSpec, Outcome, READ_ROWS, Space, States,
};
use wayfold_index::{Linear, Points, Search};

use crate::{
    fake::{Fake, exceeded, too_large},
    server::Server,
};

/// Distinct numbers without a pattern that could hide an error.
fn scattered(rows: usize, width: usize) -> States {
    let mut states = States::new(width);
    for row in 0..rows {
        let number =
            |column: usize| ((row * width + column) as f64 * 0.754_877_666_246_693).fract();
        states
            .push((0..width).map(number).collect::<Vec<_>>())
            .unwrap();
    }
    states
}

fn rows_of(requests: &[wayfold_proto::v1::KnnRequest]) -> Vec<u32> {
    requests
        .iter()
        .map(|request| request.states.as_ref().unwrap().row_count)
        .collect()
}

#[tokio::test]
async fn reads_are_divided_by_rows_and_by_the_bytes_of_their_answers() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    let states = scattered(2 * READ_ROWS + 500, 1);
    let neighbors = index.knn(&states).await.unwrap();
    assert_eq!(neighbors.len(), states.len());
    assert_eq!(rows_of(&fake.knn_requests()), [1000, 1000, 500]);
    let sent = fake
        .knn_requests()
        .into_iter()
        .flat_map(|request| request.states.unwrap().coordinates);
    assert_eq!(sent.collect::<Vec<_>>(), states.coordinates());
    // The fake numbers the rows of each call from 0.
    assert_eq!(neighbors.row(1000).ids().collect::<Vec<_>>(), [0]);
    assert_eq!(neighbors.row(2499).ids().collect::<Vec<_>>(), [499]);

    // 10,000 neighbours of 16 bytes each: 26 states fill 4 MiB.
    index.knn(&scattered(60, 1)).k(10_000).await.unwrap();
    assert_eq!(rows_of(&fake.knn_requests()[3..]), [26, 26, 8]);
    // A tag and a revision of up to 10 bytes make it 34 bytes each: 12 states fill 4 MiB.
    let include = Include::none().tags().revisions();
    let broken = index
        .knn(&scattered(13, 1))
        .k(10_000)
        .include(include)
        .await
        .unwrap_err();
    assert!(
        matches!(broken, Error::Protocol { .. }),
        "the fake sends no tags"
    );
    assert_eq!(rows_of(&fake.knn_requests()[6..]), [12]);
}

#[tokio::test]
async fn an_answer_that_is_too_large_is_asked_for_by_halves() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    fake.fail(|_, rows| (rows > 300).then(|| too_large("max_answer_bytes")));
    assert_eq!(index.knn(&scattered(1000, 1)).await.unwrap().len(), 1000);
    assert_eq!(
        rows_of(&fake.knn_requests()),
        [1000, 500, 250, 250, 250, 250]
    );

    // The limit on `k` does not depend on the rows: the call fails at once. The limit on the bytes of an answer makes
    // the client halve the rows: the call fails once a single row exceeds the limit.
    fake.fail(|_, _| Some(too_large("max_k")));
    assert_eq!(
        index.knn(&scattered(1000, 1)).await.unwrap_err().code(),
        Code::ResourceExhausted
    );
    assert_eq!(fake.calls(), 1);
    fake.fail(|_, _| Some(too_large("max_answer_bytes")));
    assert_eq!(
        index.knn(&scattered(1000, 1)).await.unwrap_err().code(),
        Code::ResourceExhausted
    );
    assert_eq!(
        fake.calls(),
        11,
        "1000, 500, 250, 125, 63, 32, 16, 8, 4, 2, 1"
    );
}

#[tokio::test]
async fn the_revision_of_each_row_is_kept() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    fake.tell([20, 10, 30]);
    let neighbors = index.knn(&scattered(2500, 1)).await.unwrap();
    let seen = [0, 999, 1000, 1999, 2000, 2499].map(|row| neighbors.revision_of(row).number);
    assert_eq!(seen, [20, 20, 10, 10, 30, 30]);
    assert_eq!(
        neighbors.revision().number,
        10,
        "the oldest: what was stored up to it is in every row"
    );
}

#[tokio::test]
async fn a_divided_insert_is_atomic_by_part() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    let limit = fake.client().await.server().await.unwrap().limits;
    let rows = 2 * limit.max_rows_per_call + 5000;
    let ids: Vec<u64> = (0..rows as u64).rev().collect();
    let states = scattered(rows, 1);
    let inserted = index
        .insert(&states)
        .ids(ids.clone())
        .operation_id("big")
        .await
        .unwrap();
    assert_eq!(inserted.outcomes.len(), rows);
    let requests = fake.insert_requests();
    let operations: Vec<&str> = requests
        .iter()
        .map(|request| request.operation_id.as_str())
        .collect();
    // If other limits divide the same call in another way, an id comes with other rows, and nothing takes effect twice.
    let [second, third] = [1, 2].map(|part| format!("big/{}", part * limit.max_rows_per_call));
    assert_eq!(operations, ["big", &second, &third]);
    let sent: Vec<u64> = requests
        .iter()
        .flat_map(|request| request.ids.clone())
        .collect();
    assert_eq!(sent, ids);

    fake.fail(|number, _| {
        (number == 2).then(|| Status::invalid_argument("states[3].coords[0]: NaN"))
    });
    let error = index.insert(&states).await.unwrap_err();
    assert_eq!(error.code(), Code::InvalidArgument);
    let message =
        "rows 0 to 19999 of 25000 took effect; then: states[3].coords[0]: NaN (INVALID_ARGUMENT)";
    assert_eq!(error.to_string(), message);
    let Error::Partial {
        done, ids: stored, ..
    } = error
    else {
        panic!("{error}");
    };
    assert_eq!(done, 20_000);
    // The fake server counts from 0 in each call.
    assert!(stored.into_iter().eq((0..10_000).chain(0..10_000)));

    // An argument that one call would refuse fails before the first part is sent.
    let mut twice = ids;
    twice[rows - 1] = twice[0];
    let error = index.insert(&states).ids(twice).await.unwrap_err();
    assert_eq!(
        error.to_string(),
        format!("ids: {} is given twice", rows - 1)
    );
    assert_eq!(fake.calls(), 3);
    let long = index
        .insert(&states)
        .operation_id("x".repeat(63))
        .await
        .unwrap_err();
    assert!(
        matches!(
            long,
            Error::Argument {
                field: "operation_id",
                ..
            }
        ),
        "{long}"
    );
}

#[tokio::test]
async fn payloads_divide_an_insert_too() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    let payloads = vec![vec![0_u8; 64 * 1024]; 100];
    index
        .insert(&scattered(100, 1))
        .payloads(payloads)
        .await
        .unwrap();
    let rows: Vec<usize> = fake
        .insert_requests()
        .iter()
        .map(|request| request.payloads.len())
        .collect();
    // 62 of 64 KiB are as many as 4 MiB less 64 KiB hold.
    assert_eq!(rows, [62, 38]);

    index
        .insert(&scattered(300, 1))
        .neighbors(NeighborSpec::k(1000))
        .await
        .unwrap();
    let rows: Vec<u32> = fake.insert_requests()[2..]
        .iter()
        .map(|one| one.states.as_ref().unwrap().row_count)
        .collect();
    // 261 rows of 1000 neighbours of 16 bytes.
    assert_eq!(rows, [261, 39]);
}

#[tokio::test]
async fn the_server_is_asked_once_for_its_limits_and_only_where_they_matter() {
    let fake = Fake::start().await;
    let client = fake.client().await;
    let index = client.index("line").await.unwrap();
    index.knn(&scattered(1, 1)).await.unwrap();
    index.insert(&scattered(1, 1)).await.unwrap();
    index.remove([1]).await.unwrap();
    assert_eq!(fake.times_described(), 0, "a single row is not divided");
    index.knn(&scattered(2, 1)).await.unwrap();
    index.insert(&scattered(2, 1)).await.unwrap();
    index.update([1, 2]).tags([3]).await.unwrap();
    client.clone().index("line").await.unwrap();
    index.remove([1, 2]).await.unwrap();
    assert_eq!(fake.times_described(), 1);
    let server = client.server().await.unwrap();
    assert_eq!(
        (
            server.version.as_str(),
            server.durability,
            server.limits.max_ids_per_call
        ),
        ("1.2.3", Durability::Memory, 10_000)
    );
}

/// A server that was started again may have lower limits than the client knows.
#[tokio::test]
async fn after_a_refusal_that_names_a_lower_limit_the_rest_is_divided_anew() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    let insert = |rows| index.insert(&scattered(rows, 1)).operation_id("big");
    insert(2).await.unwrap();
    fake.limit_rows(1000);
    let inserted = insert(12_500).await.unwrap();
    assert_eq!(inserted.outcomes.len(), 12_500);
    insert(1500).await.unwrap();
    let sent: Vec<(u32, String)> = fake
        .insert_requests()
        .into_iter()
        .map(|sent| (sent.states.unwrap().row_count, sent.operation_id))
        .collect();
    let part = |rows, start: usize| match start {
        0 => (rows, "big".to_owned()),
        row => (rows, format!("big/{row}")),
    };
    // The first that is too large, then its parts; the later insert is within the limits at once.
    let mut expected = vec![part(2, 0), part(10_000, 0)];
    expected.extend((0..12).map(|at| part(1000, at * 1000)));
    expected.extend([part(500, 12_000), part(1000, 0), part(500, 1000)]);
    assert_eq!(sent, expected);
    assert_eq!(fake.times_described(), 2);
}

/// A limit that is named and not lowered cannot be kept by another division.
#[tokio::test]
async fn a_refusal_that_names_no_lower_limit_fails_a_mutation() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    fake.fail(|number, _| (number > 0).then(|| exceeded("max_rows_per_call", 10_000)));
    let error = index.insert(&scattered(20_000, 1)).await.unwrap_err();
    assert!(
        matches!(error, Error::Partial { done: 10_000, .. }),
        "{error}"
    );
    assert_eq!(error.code(), Code::ResourceExhausted);
    assert_eq!((fake.calls(), fake.times_described()), (2, 1));
}

#[tokio::test]
async fn columns_have_a_value_for_each_row() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    let error = index.insert([[0.0], [1.0]]).tags([1]).await.unwrap_err();
    assert_eq!(error.to_string(), "tags: 1 given for 2 states");
    let error = index.update([1, 2, 3]).tags([1, 2]).await.unwrap_err();
    assert_eq!(error.to_string(), "tags: 2 given for 3 ids");
    index
        .remove((0..25_000).collect::<Vec<u64>>())
        .await
        .unwrap();
    let removed: Vec<usize> = fake
        .remove_requests()
        .iter()
        .map(|request| request.ids.len())
        .collect();
    assert_eq!(removed, [10_000, 10_000, 5_000]);
}

/// Against the real server, with limits that a few rows exceed, the answers are those of brute force.
#[tokio::test]
async fn joined_answers_of_divided_calls_equal_brute_force() {
    let server = Server::with(|config| {
        config.limits.max_rows_per_call = 1_500;
        config.limits.max_ids_per_call = 300;
        config.limits.max_answer_bytes = 40_000;
    });
    let index = server.index("se2", "R2*SO2").await;
    let space: Space = "R2*SO2".parse().unwrap();
    let stored = scattered(2500, 3);
    let include = Include::none().states().tags();
    let tags: Vec<u64> = (0..2500).map(|id| id * 3).collect();
    index.insert(&stored).tags(tags).await.unwrap();

    let mut oracle = Linear::new(space.clone());
    let mut points = Points::new(3);
    for (id, row) in stored.iter().enumerate() {
        let mut row = row.to_vec();
        space.canonicalize(&mut row).unwrap();
        points.push(id as u64, id as u64 * 3, 1, &row);
    }
    for point in points.iter() {
        oracle.insert(point).unwrap();
    }

    let queries = scattered(1500, 3);
    let nearest = index.knn(&queries).k(20).include(include).await.unwrap();
    let around = index.query(&queries, 0.05).include(include).await.unwrap();
    assert_eq!((nearest.len(), around.len()), (1500, 1500));
    for (i, state) in queries.iter().enumerate() {
        let mut state = state.to_vec();
        space.canonicalize(&mut state).unwrap();
        for (row, search) in [
            (nearest.row(i), Search::nearest_k(20)),
            (around.row(i), Search::nearest_r(0.05)),
        ] {
            let expected = oracle.search(&state, &search).unwrap().neighbors;
            assert_eq!(row.iter().collect::<Vec<_>>(), expected);
            for (place, id) in row.ids().enumerate() {
                assert_eq!(row.state(place).unwrap(), points.row(id as usize));
                assert_eq!(row.tags().unwrap()[place], id * 3);
            }
        }
    }
    let ids: Vec<u64> = (0..2500).rev().collect();
    let read = index.get(ids.clone()).await.unwrap();
    assert_eq!(read.ids(), ids);
    assert!(
        read.iter()
            .all(|point| point.state == points.row(point.id as usize))
    );
}

/// A client that takes less in one answer than the server sends asks for less.
#[tokio::test]
async fn a_client_that_takes_little_asks_for_little() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    let inserted = index.insert(&scattered(3000, 1)).await.unwrap();
    assert_eq!(inserted.outcomes[2999], Outcome::Inserted { id: 2999 });
    let client = Client::builder()
        .max_message_bytes(20_000)
        .connect(&server.uri)
        .await
        .unwrap();
    let small = client.index("line").await.unwrap();
    let queries = scattered(50, 1);
    // All points within a radius: the number of neighbours is not known before.
    let all = small.query(&queries, 0.1).await.unwrap();
    assert!(all == index.query(&queries, 0.1).await.unwrap());
    assert!(all.rows().all(|row| row.len() > 200));
    let error = small.query(&queries, f64::INFINITY).await.unwrap_err();
    assert_eq!(error.code(), Code::OutOfRange, "{error}");
}
