//! A replica answers like brute force at the revision that it names, despite failures of its server and of the
//! connection.

mod history;
mod proxy;

use std::{
    path::Path,
    process::Command,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use wayfold::{Code, Error, Include, ReplicaStatus, ResetReason, WatchEvent};
use wayfold_index::{Linear, Space};
use wayfold_tests::{Process, ServerProcess, Signal, States, server};

use history::{History, ReplicaAnswer, client, compare};
use proxy::Proxy;

const SPACE: &str = "R2*SO2*SO3:0.15";

/// A server on disk whose first tree is so small that a merge is nearly always under way.
fn start(data: &Path) -> ServerProcess {
    let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
    command
        .args(["--grpc", "127.0.0.1:0", "--data"])
        .arg(data)
        .env("WAYFOLD_INDEX__GROWING_ROWS", "32");
    ServerProcess::ready(Process::spawn(&mut command))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_answer_is_brute_forces_through_kills_and_cuts() {
    const CALLS: u64 = 250;
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().join("data");
    let mut server = start(&data);
    let (steady, shaky) = (Proxy::to(server.uri()).await, Proxy::to(server.uri()).await);
    let space: Space = SPACE.parse().unwrap();
    let index = client(&steady.uri)
        .await
        .create_index("arm", &space)
        .await
        .unwrap();
    let replica = client(&shaky.uri).await.replica("arm").await.unwrap();

    let stop = Arc::new(AtomicBool::new(false));
    let readers = [0, 1, 2].map(|seed| {
        let (replica, space, stop) = (replica.clone(), space.clone(), stop.clone());
        std::thread::spawn(move || history::ask(&replica, space, seed, &stop))
    });
    let writers = [1, 2].map(|name| tokio::spawn(history::write(index.clone(), name, CALLS)));
    for revision in (25..2 * CALLS).step_by(25) {
        let reached = index.revision_at(revision);
        replica.at_least(&reached).await.unwrap();
        if revision % 200 == 0 {
            // One server is killed, and its clients reconnect.
            server.stop(Signal::Kill);
            server = start(&data);
            steady.lead_to(server.uri());
            shaky.lead_to(server.uri());
        } else {
            // The kill falls into the middle of a call.
            shaky.cut_after(i64::try_from(revision * 37).unwrap());
        }
    }
    let mut past = History::new();
    for writer in writers {
        past.extend(writer.await.unwrap());
    }
    replica
        .at_least(&index.revision_at(2 * CALLS))
        .await
        .unwrap();
    stop.store(true, Ordering::Relaxed);
    let answers: Vec<ReplicaAnswer> = readers
        .into_iter()
        .flat_map(|reader| reader.join().unwrap())
        .collect();
    println!("{} answers, {} cuts", answers.len(), shaky.cuts());
    assert!(
        answers
            .iter()
            .all(|answered| &*answered.found.revision().uid == index.uid())
    );
    let points = history::check(&space, &past, answers);
    compare(&replica, &points);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_replica_that_missed_too_much_reads_everything_anew() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
    command
        .args(["--grpc", "127.0.0.1:0"])
        .env("WAYFOLD_DATA__DIR", "memory")
        .env("WAYFOLD_INDEX__WINDOW_BYTES", "1000");
    let server = ServerProcess::ready(Process::spawn(&mut command));
    let way = Proxy::to(server.uri()).await;
    let space: Space = SPACE.parse().unwrap();
    let index = client(server.uri())
        .await
        .create_index("arm", &space)
        .await
        .unwrap();
    let mut states = States::new(space.clone(), 5);
    let inserted = index.insert([states.row(), states.row()]).await.unwrap();
    let replica = client(&way.uri).await.replica("arm").await.unwrap();
    let mut slow = index
        .watch()
        .after(inserted.revision.clone())
        .include(Include::all())
        .await
        .unwrap();

    // The replica loses its connection once, and once its proxy sends nothing.
    for held in [false, true] {
        let from = replica.revision();
        match held {
            true => way.hold(server.uri()),
            false => way.close(),
        }
        index.remove([inserted_id(from.number)]).await.unwrap();
        let large = vec![vec![7_u8; 60_000]; 50];
        for _ in 0..4 {
            // This exceeds the server's window of records and the buffers of the network.
            let rows = states.rows(50);
            let insert = index.insert(rows.chunks(space.coordinates()));
            index_payloads(insert, &large).await;
        }
        let newest = index.info().await.unwrap().revision;
        let mut watch = index.watch().after(from.clone()).await.unwrap();
        let Ok(Some(WatchEvent::Reset(reset))) = watch.next().await else {
            panic!("the window is wider than thought")
        };
        assert_eq!(
            (reset.reason, &reset.revision),
            (ResetReason::WindowPassed, &newest)
        );
        assert_eq!(replica.revision(), from);
        way.lead_to(server.uri());
        replica.at_least(&newest).await.unwrap();
        let mut points = Linear::new(space.clone());
        let mut scan = index.scan().await.unwrap();
        while let Some(part) = scan.next().await.unwrap() {
            for point in part.iter() {
                points
                    .insert(wayfold_index::PointRef {
                        id: point.id,
                        tag: point.tag,
                        revision: point.revision,
                        row: point.state,
                    })
                    .unwrap();
            }
        }
        compare(&replica, &points);
    }

    // A follower that read nothing meanwhile gets the buffered mutations without a gap, and then a reset.
    let mut revision = inserted.revision.number;
    loop {
        match slow.next().await.unwrap().unwrap() {
            WatchEvent::Mutation(mutation) => {
                revision += 1;
                assert_eq!(mutation.revision, index.revision_at(revision));
            }
            WatchEvent::Reset(reset) => {
                assert_eq!(reset.reason, ResetReason::WindowPassed);
                assert!(revision < reset.revision.number);
                break;
            }
        }
    }
}

/// The first two inserts made this stored revision.
fn inserted_id(revision: u64) -> u64 {
    u64::from(revision > 1)
}

async fn index_payloads(insert: wayfold::Insert, payloads: &[Vec<u8>]) {
    insert.payloads(payloads.to_vec()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_index_made_anew_is_noticed_by_its_uid() {
    let server = server!();
    let way = Proxy::to(server.uri()).await;
    let direct = client(server.uri()).await;
    let line = direct
        .create_index("arm", &"R1".parse().unwrap())
        .await
        .unwrap();
    line.insert([[0.0], [1.0]]).await.unwrap();
    let replica = client(&way.uri).await.replica("arm").await.unwrap();
    assert_eq!(replica.knn([0.9], 1).unwrap().nearest().unwrap().id, 1);

    // Another client recreates the index with another space.
    way.close();
    direct.delete_index("arm").await.unwrap();
    let plane = direct
        .create_index("arm", &"R2".parse().unwrap())
        .await
        .unwrap();
    plane.insert([[5.0, 5.0]]).await.unwrap();
    assert_eq!(
        replica.knn([0.9], 1).unwrap().nearest().unwrap().id,
        1,
        "what it had"
    );
    let (waiting, seventh) = (replica.clone(), line.revision_at(7));
    let waiting = tokio::spawn(async move { waiting.at_least(&seventh).await });
    way.lead_to(server.uri());
    replica
        .status_where(|_| replica.index().uid() == plane.uid())
        .await;
    let found = replica.knn([5.0, 1.0], 1).unwrap();
    assert_eq!(
        (found.revision(), found.nearest().unwrap().distance),
        (plane.revision_at(1), 4.0)
    );
    assert!(matches!(replica.knn([0.9], 1), Err(Error::Width { .. })));
    let gone = waiting.await.unwrap().unwrap_err();
    assert_eq!(gone.code(), Code::FailedPrecondition, "{gone}");

    // A server in memory is killed, and its successor gets the index again.
    way.close();
    server.stop(Signal::Kill);
    let server = server!();
    let direct = client(server.uri()).await;
    let again = direct
        .create_index("arm", &"R2".parse().unwrap())
        .await
        .unwrap();
    way.lead_to(server.uri());
    replica
        .status_where(|_| replica.index().uid() == again.uid())
        .await;
    assert_eq!(replica.revision(), again.revision_at(0));
    let inserted = replica
        .write(replica.index().insert([[1.0, 0.0]]))
        .await
        .unwrap();
    let found = replica.knn([0.0, 0.0], 1).unwrap();
    assert!(found.revision().number >= inserted.revision.number);
    assert_eq!(found.nearest().unwrap().distance, 1.0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_deleted_index_ends_its_replica() {
    let server = server!();
    let direct = client(server.uri()).await;
    let line = direct
        .create_index("arm", &"R1".parse().unwrap())
        .await
        .unwrap();
    let request = direct.replica("arm").missing_for(Duration::ZERO);
    let replica = request.await.unwrap();
    replica.write(line.insert([[0.0]])).await.unwrap();
    assert_eq!(
        replica.knn([1.0], 1).unwrap().nearest().unwrap().distance,
        1.0
    );
    direct.delete_index("arm").await.unwrap();
    let ended = replica.status_where(|status| matches!(status, ReplicaStatus::Ended { .. }));
    ended.await;
    let error = replica.knn([1.0], 1).unwrap_err();
    assert!(matches!(error, Error::Ended { .. }), "{error}");
    assert_eq!(
        (error.code(), error.reason()),
        (Code::NotFound, Some("INDEX_NOT_FOUND"))
    );
    assert!(matches!(
        replica.at_least(&line.revision_at(9)).await,
        Err(Error::Ended { .. })
    ));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn inserts_through_a_replica_are_there_when_they_return() {
    let server = server!();
    let direct = client(server.uri()).await;
    let space: Space = SPACE.parse().unwrap();
    direct.create_index("arm", &space).await.unwrap();
    let replica = direct.replica("arm").await.unwrap();
    let mut states = States::new(space, 11);
    for _ in 0..200 {
        let row = states.row();
        let inserted = replica
            .write(replica.index().insert([&row[..]]))
            .await
            .unwrap();
        let found = replica.knn(&row[..], 1).unwrap();
        assert!(found.revision().number >= inserted.revision.number);
        assert_eq!(found.nearest().unwrap().distance, 0.0);
    }
}
