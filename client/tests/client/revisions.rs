//! Read-your-writes: the reads of a handle ask for the newest revision that the handle has seen.

use std::time::Duration;

use tokio::task::JoinSet;
use wayfold::{Client, Code, NeighborSpec, Outcome, Revision};

use crate::{
    fake::{Fake, UID, revision},
    scaling::{SPACE, rows},
    server::Server,
};

#[tokio::test]
async fn reads_ask_for_the_last_revision_that_was_told() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    let clone = index.clone();
    index.knn([[0.0]]).await.unwrap();
    fake.tell([7]);
    index.insert([[0.0]]).await.unwrap();
    // An answer of an older revision does not replace the newer one.
    fake.tell([5]);
    clone.knn([[0.0]]).await.unwrap();
    clone.remove([1]).await.unwrap();
    clone.knn([[0.0]]).await.unwrap();
    index.see_revision(&index.revision_at(9)).unwrap();
    clone.knn([[0.0]]).await.unwrap();
    let revisions = fake
        .knn_requests()
        .into_iter()
        .map(|request| request.min_revision.unwrap());
    let revisions: Vec<(String, u64)> = revisions.map(|at| (at.uid, at.number)).collect();
    assert_eq!(
        revisions,
        [0, 7, 7, 9].map(|revision| (UID.to_owned(), revision))
    );
    assert_eq!(index.revision(), Revision::new(UID, 9));

    let other = index
        .see_revision(&Revision::new("another", 12))
        .unwrap_err();
    assert_eq!(
        (other.code(), other.reason()),
        (Code::FailedPrecondition, Some("UID_MISMATCH"))
    );
    assert_eq!(index.revision().number, 9);
}

#[tokio::test]
async fn a_read_of_a_revision_that_does_not_come_runs_into_its_deadline() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    let inserted = index.insert([[0.0]]).await.unwrap();
    assert_eq!(index.revision(), inserted.revision);
    let next = index.revision_at(inserted.revision.number + 1);
    index.see_revision(&next).unwrap();
    let error = index
        .with_timeout(Duration::from_millis(50))
        .knn([[0.0]])
        .await
        .unwrap_err();
    assert_eq!(error.code(), Code::DeadlineExceeded, "{error}");

    // Another worker writes the revision: a read that waits for it has it.
    let other = Client::connect(&server.uri)
        .await
        .unwrap()
        .index("line")
        .await
        .unwrap();
    let (neighbors, inserted) = tokio::join!(
        index.knn([[5.0]]).into_future(),
        other.insert([[5.0]]).into_future()
    );
    assert_eq!(neighbors.unwrap().row(0).ids().collect::<Vec<_>>(), [1]);
    assert_eq!(inserted.unwrap().revision.number, 2);
}

/// A stream has no deadline, and the server bounds the wait of such a call.
#[tokio::test]
async fn a_call_with_a_deadline_waits_for_the_revision_of_a_stream() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    index.see_revision(&index.revision_at(7)).unwrap();
    let known = fake.timeouts().len();
    // The fake's streams are empty.
    fake.snapshots(&[], true);
    index.scan().await.unwrap_err();
    index.snapshot().await.unwrap_err();
    index.verify().await.unwrap_err();
    let waits = fake.get_requests().into_iter();
    let revisions: Vec<_> = waits.map(|wait| wait.min_revision).collect();
    assert_eq!(revisions, [revision(7), revision(7), revision(7)]);
    let timeouts = fake.timeouts().into_iter().skip(known);
    let have_deadlines: Vec<bool> = timeouts.map(|timeout| timeout.is_some()).collect();
    assert_eq!(have_deadlines, [true, false, true, false, true, false]);
}

#[tokio::test]
async fn a_handle_is_of_one_uid() {
    let server = Server::start();
    let client = server.client().await;
    let space = "R1".parse().unwrap();
    let old = client.create_index("line", &space).await.unwrap();
    old.insert([[0.0]]).await.unwrap();
    assert_eq!(client.delete_index("line").await.unwrap(), old.uid());
    let new = client.create_index("line", &space).await.unwrap();
    assert_ne!(old.uid(), new.uid());
    let insert = old.insert([[1.0]]).await.unwrap_err();
    let read = old.knn([[1.0]]).await.unwrap_err();
    assert_eq!(
        (insert.code(), insert.reason()),
        (Code::FailedPrecondition, Some("UID_MISMATCH"))
    );
    assert_eq!(read.code(), Code::FailedPrecondition);
    assert_eq!(new.info().await.unwrap().revision.number, 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn planners_read_what_they_wrote() {
    let server = Server::start();
    let mut planners = JoinSet::new();
    for planner in 0..6 {
        let client = server.client().await;
        planners.spawn(async move {
            let space = SPACE.parse().unwrap();
            let roadmap = client.create_index("car", &space).await.unwrap();
            for row in rows(50 * planner, 50) {
                let around = NeighborSpec::k(4);
                let inserted = roadmap.insert([row]).neighbors(around).await.unwrap();
                let Outcome::Inserted { id } = inserted.outcomes[0] else {
                    panic!("{inserted:?}");
                };
                // The read sees a revision that has the point, and no other point is as near.
                let found = roadmap.knn([row]).k(1).await.unwrap();
                let itself = found.row(0).nearest().unwrap();
                assert_eq!((itself.id, itself.distance), (id, 0.0));
                assert!(found.revision().number >= inserted.revision.number);
                let around = inserted.neighbors.unwrap();
                assert!(
                    around.row(0).ids().all(|other| other != id),
                    "its own neighbour"
                );
            }
        });
    }
    planners.join_all().await;
}
