//! Each request against a real server.

use wayfold::{Client, Code, Durability, Error, Filter, Include, NeighborSpec, Outcome};

use crate::server::Server;

#[tokio::test]
async fn inserts_tell_outcomes_and_the_neighbours_of_the_moment() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    let first = index
        .insert([[0.0], [10.0]])
        .ids([5, 6])
        .tags([1, 2])
        .payloads(["a", "bc"])
        .await
        .unwrap();
    assert_eq!(
        first.outcomes,
        [Outcome::Inserted { id: 5 }, Outcome::Inserted { id: 6 }]
    );
    assert_eq!((first.revision.number, first.neighbors), (1, None));

    let around = NeighborSpec::within(2.0).include(Include::all());
    let second = index
        .insert([[1.0], [1.5], [9.75]])
        .min_separation(0.5)
        .neighbors(around)
        .await
        .unwrap();
    let expected = [
        Outcome::Inserted { id: 7 },
        Outcome::Inserted { id: 8 },
        Outcome::TooClose { blocker: 6 },
    ];
    assert_eq!(second.outcomes, expected);
    let stored: Vec<_> = second.outcomes.iter().map(|outcome| outcome.id()).collect();
    assert_eq!(stored, [Some(7), Some(8), None]);
    let neighbors = second.neighbors.unwrap();
    let found: Vec<Vec<(u64, f64)>> = neighbors
        .rows()
        .map(|row| row.iter().map(|near| (near.id, near.distance)).collect())
        .collect();
    assert_eq!(
        found,
        [vec![(5, 1.0)], vec![(7, 0.5), (5, 1.5)], vec![(6, 0.25)]]
    );
    let last = neighbors.row(2);
    assert_eq!(
        (last.state(0), last.tags()),
        (Some(&[10.0][..]), Some(&[2][..]))
    );
    assert_eq!((last.revisions(), last.state(1)), (Some(&[1][..]), None));
    assert_eq!(last.payloads().unwrap(), ["bc"]);
    assert_eq!(neighbors.revision(), second.revision);
    assert_eq!(second.revision, index.revision_at(2));

    let again = index
        .insert([[0.0]])
        .ids([5])
        .tags([1])
        .payloads(["a"])
        .await
        .unwrap();
    assert_eq!(
        (again.outcomes[0], again.revision),
        (Outcome::Unchanged { id: 5 }, index.revision_at(2))
    );
    let conflict = index.insert([[3.0], [4.0]]).ids([5, 6]).await.unwrap_err();
    let Error::Refused(refusal) = &conflict else {
        panic!("{conflict}")
    };
    assert_eq!(
        (refusal.code, &*refusal.ids),
        (Code::AlreadyExists, &[5, 6][..])
    );
    let replaced = index.insert([[3.0]]).ids([5]).replace().await.unwrap();
    assert_eq!(replaced.outcomes, [Outcome::Replaced { id: 5 }]);
}

#[tokio::test]
async fn an_operation_takes_effect_once() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    let first = index.insert([[0.0]]).operation_id("one").await.unwrap();
    let again = index.insert([[0.0]]).operation_id("one").await.unwrap();
    assert_eq!(first, again);
    let other = index.insert([[1.0]]).operation_id("one").await.unwrap_err();
    assert_eq!(other.code(), Code::InvalidArgument);
    assert_eq!(index.info().await.unwrap().point_count, 1);
}

#[tokio::test]
async fn tags_are_set_compared_and_filtered_by() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    index.insert([[0.0], [1.0], [2.0]]).await.unwrap();
    let updated = index.update([0, 2]).tags([0b11]).await.unwrap();
    assert_eq!((updated.updated_count, updated.unchanged_count), (2, 0));
    assert_eq!(updated.revision, index.revision_at(2));
    let masked = index
        .update([0, 1])
        .tags([0b00, 0b10])
        .tag_mask(0b10)
        .await
        .unwrap();
    assert_eq!(masked.updated_count, 2);
    let tags: Vec<u64> = index
        .get([0, 1, 2])
        .await
        .unwrap()
        .iter()
        .map(|point| point.tag)
        .collect();
    assert_eq!(tags, [0b01, 0b10, 0b11]);

    let odd = Filter::default().tag(1, 1);
    let nearest = index.knn([[1.1]]).k(3).filter(odd.clone()).await.unwrap();
    assert_eq!(nearest.row(0).ids().collect::<Vec<_>>(), [2, 0]);
    let around = index.query([[1.1]], 1.0).filter(odd).await.unwrap();
    assert_eq!(around.row(0).ids().collect::<Vec<_>>(), [2]);

    let late = index
        .update([0, 2])
        .tags([7])
        .if_revision(index.revision_at(2))
        .await
        .unwrap_err();
    let Error::Refused(refusal) = &late else {
        panic!("{late}")
    };
    assert_eq!(
        (&*refusal.reason, &*refusal.ids),
        ("REVISION_CONFLICT", &[0][..])
    );

    index.update([1]).payloads(["edge list"]).await.unwrap();
    let read = index.get([1]).include(Include::all()).await.unwrap();
    assert_eq!(read.point(0).payload.unwrap(), "edge list");
    assert_eq!(index.get([1]).await.unwrap().point(0).payload, None);
}

#[tokio::test]
async fn only_what_is_new_since_a_revision_is_found() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    index.insert([[0.0]]).await.unwrap();
    let known = index.knn([[0.0]]).k(5).await.unwrap().revision();
    index.insert([[1.0]]).await.unwrap();
    let new = Filter::default().since(known);
    assert_eq!(
        index
            .knn([[0.0]])
            .k(5)
            .filter(new)
            .await
            .unwrap()
            .row(0)
            .ids()
            .collect::<Vec<_>>(),
        [1]
    );
}

#[tokio::test]
async fn removed_points_are_missing_by_name() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    index.insert([[0.0], [1.0], [2.0]]).await.unwrap();
    let removed = index.remove([1, 50]).await.unwrap();
    assert_eq!((removed.removed_count, removed.missing_count), (1, 1));
    assert_eq!(removed.revision, index.revision_at(2));
    let error = index.get([0, 1, 50]).await.unwrap_err();
    let Error::Refused(refusal) = &error else {
        panic!("{error}")
    };
    assert_eq!(
        (refusal.code, &*refusal.reason, &*refusal.ids),
        (Code::NotFound, "POINTS_NOT_FOUND", &[1, 50][..])
    );
}

#[tokio::test]
async fn refusals_name_the_fields() {
    let server = Server::start();
    let index = server.index("plane", "R2").await;
    let error = index
        .insert([[0.0, 1.0], [0.0, f64::NAN]])
        .await
        .unwrap_err();
    let Error::Refused(refusal) = &error else {
        panic!("{error}")
    };
    assert_eq!(
        (refusal.code, error.reason()),
        (Code::InvalidArgument, Some("NAN"))
    );
    assert_eq!(refusal.fields[0].field, "states[1].coords[1]");
    let message = error.to_string();
    assert!(
        message.contains("states[1].coords[1]") && message.ends_with("(INVALID_ARGUMENT)"),
        "{message}"
    );
    assert_eq!(
        index.knn([[0.0, 0.0]]).k(0).await.unwrap_err().code(),
        Code::InvalidArgument
    );
}

#[tokio::test]
async fn a_scan_reads_all_points_of_one_revision() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    index
        .insert((0..30_000).map(|x| [f64::from(x)]))
        .await
        .unwrap();
    index.update([29_999]).tags([1]).await.unwrap();
    let mut scan = index.scan().await.unwrap();
    let revision = scan.revision().clone();
    assert_eq!((scan.point_count(), &revision), (30_000, &index.revision()));
    // The scan still reads a point that is removed meanwhile.
    index.remove([15_000]).await.unwrap();
    let mut next = 0;
    while let Some(part) = scan.next().await.unwrap() {
        assert_eq!(part.revision(), revision);
        for point in part.iter() {
            assert_eq!((point.id, point.state), (next, &[next as f64][..]));
            next += 1;
        }
    }
    assert_eq!(next, 30_000);

    let tagged = Filter::default().tag(1, 1);
    let mut rest = index
        .scan()
        .filter(tagged)
        .after_id(29_000)
        .include(Include::all())
        .await
        .unwrap();
    let part = rest.next().await.unwrap().unwrap();
    assert_eq!(part.ids(), [29_999]);
    assert!(part.point(0).payload.unwrap().is_empty());
}

#[tokio::test]
async fn the_parts_of_a_scan_keep_to_the_client_s_own_limit() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    let states = (0..300).map(|x| [f64::from(x)]);
    index.insert(states).await.unwrap();
    let client = Client::builder().max_message_bytes(2_000);
    let small = client.connect(&server.uri).await.unwrap();
    let mut scan = small.index("line").await.unwrap().scan().await.unwrap();
    let mut ids = Vec::new();
    while let Some(part) = scan.next().await.unwrap() {
        ids.extend_from_slice(part.ids());
    }
    assert_eq!(ids, (0..300).collect::<Vec<_>>());
}

#[tokio::test]
async fn a_scan_is_a_stream_of_parts() {
    use futures_util::TryStreamExt;

    let server = Server::start();
    let index = server.index("line", "R1").await;
    let empty: Vec<_> = index
        .scan()
        .await
        .unwrap()
        .into_stream()
        .try_collect()
        .await
        .unwrap();
    assert_eq!(empty.iter().map(wayfold::Points::len).sum::<usize>(), 0);
    index.insert([[3.0], [4.0]]).await.unwrap();
    let parts: Vec<_> = index
        .scan()
        .await
        .unwrap()
        .into_stream()
        .try_collect()
        .await
        .unwrap();
    let states: Vec<f64> = parts
        .iter()
        .flat_map(|part| part.states().unwrap().coordinates().to_vec())
        .collect();
    assert_eq!(states, [3.0, 4.0]);
}

#[tokio::test]
async fn indices_are_listed_over_all_pages() {
    let server = Server::start();
    let client = server.client().await;
    let space = "R2*SO2".parse().unwrap();
    let names: Vec<String> = (0..250).map(|i| format!("index-{i:03}")).collect();
    for name in &names {
        client.create_index(name, &space).await.unwrap();
    }
    let listed = client.list_indexes().await.unwrap();
    assert_eq!(listed.damaged, []);
    let listed = listed.indexes;
    let listed_names: Vec<&str> = listed.iter().map(|index| index.name.as_str()).collect();
    assert_eq!(listed_names, names);
    assert!(
        listed.iter().all(
            |index| index.space == space && (index.coordinate_count, index.dimension) == (3, 3)
        )
    );
}

#[tokio::test]
async fn reads_have_the_columns_that_they_include() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    let insert = index.insert([[2.5]]).ids([7]).tags([3]);
    insert.payloads(["edges"]).await.unwrap();
    let tags = Include::none().tags();
    let bare = index.get([7]).include(Include::none()).await.unwrap();
    let tagged = index.get([7]).include(tags).await.unwrap();
    let mut scan = index.scan().include(tags).await.unwrap();
    let scanned = scan.next().await.unwrap().unwrap();
    assert_eq!((bare.ids(), bare.states()), (&[7][..], None));
    assert_eq!((tagged.point(0).tag, tagged.point(0).payload), (3, None));
    assert!(tagged.states().is_none());
    assert_eq!((scanned.point(0).tag, scanned.states()), (3, None));
    let all = index.get([7]).include(Include::all()).await.unwrap();
    let point = all.point(0);
    assert_eq!((point.state, point.tag, point.revision), (&[2.5][..], 3, 1));
    assert_eq!(point.payload.unwrap(), "edges");
}

#[tokio::test]
async fn a_server_describes_itself() {
    let server = Server::with(|config| config.limits.max_rows_per_call = 123);
    let client = server.client().await;
    let found = client.server().await.unwrap();
    assert_eq!(found.version, env!("CARGO_PKG_VERSION"));
    assert_eq!(found.durability, Durability::Memory);
    assert_eq!(found.limits.max_rows_per_call, 123);
    assert_eq!(found.limits.max_payload_bytes, 64 * 1024);
}

/// The number of neighbours within a radius is not known before.
#[tokio::test]
async fn an_insert_whose_neighbours_are_too_many_is_asked_for_by_halves() {
    let server = Server::with(|config| config.limits.max_answer_bytes = 20_000);
    let index = server.index("line", "R1").await;
    let all = NeighborSpec::within(f64::INFINITY);
    let inserted = index
        .insert((0..300).map(|x| [f64::from(x)]))
        .neighbors(all.clone())
        .await;
    let inserted = inserted.unwrap();
    let ids: Vec<Option<u64>> = inserted.outcomes.iter().map(|it| it.id()).collect();
    assert_eq!(ids, (0..300).map(Some).collect::<Vec<_>>());
    let neighbors = inserted.neighbors.unwrap();
    for row in 0..300 {
        let mut found: Vec<u64> = neighbors.row(row).ids().collect();
        found.sort_unstable();
        assert_eq!(found, (0..row as u64).collect::<Vec<_>>());
    }

    // An answer that the client itself does not read: the points are there.
    let client = Client::builder().max_message_bytes(2_000);
    let small = client.connect(&server.uri).await.unwrap();
    let small = small.index("line").await.unwrap();
    let error = small.insert([[0.5]]).neighbors(all).await.unwrap_err();
    let is_done = matches!(
        error,
        Error::Partial {
            done: 1,
            rows: 1,
            ..
        }
    );
    assert!(is_done, "{error}");
    assert_eq!(error.code(), Code::OutOfRange);
    assert_eq!(index.info().await.unwrap().point_count, 301);
}
