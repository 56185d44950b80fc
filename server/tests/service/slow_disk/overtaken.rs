//! Mutations that other writers overtake while they read from a slow disk.

use std::sync::Arc;

use futures_util::{
    future::{BoxFuture, join_all},
    poll,
};
use wayfold_proto::v1;
use wayfold_server::{
    registry::RegistryOptions,
    service::{Error, Limits, Service},
};

use super::{answer_others, first_points, neighbor_payloads, payload, serving, ten_points};
use crate::{fault::FaultLog, support::*};

/// Serves the content of the log, with a cache of records that holds less than one record.
fn serving_without_cache(log: &FaultLog, limits: Limits) -> Service {
    let options = RegistryOptions {
        window_bytes: 1,
        ..options()
    };
    restarted_with(Arc::new(log.clone()), options, limits)
}

/// Polls a call until it waits for a read. On a busy machine it yields before.
async fn until_it_reads<T>(log: &FaultLog, call: &mut (impl Future<Output = T> + Unpin)) {
    tokio::select! {
        () = log.gate().holds_a_read() => {}
        _ = call => panic!("it ended without a read"),
    }
}

/// Begins a call and makes a change once the call has begun to read the stored points. Returns the call's outcome.
async fn overtaken<T>(
    call: impl AsyncFnOnce(Service) -> Result<T, Error>,
    change: impl AsyncFnOnce(Service),
) -> (Service, Result<T, Error>) {
    let (log, _) = ten_points().await;
    let service = serving(&log);
    log.gate().close();
    let mut call = Box::pin(call(service.clone()));
    until_it_reads(&log, &mut call).await;
    log.gate().open();
    change(service.clone()).await;
    (service, call.await)
}

fn update(tags: &[u64], payloads: &[&'static str]) -> v1::UpdateRequest {
    v1::UpdateRequest {
        tags: tags.into(),
        payloads: payloads.iter().map(|payload| (*payload).into()).collect(),
        ..updating(&[3])
    }
}

async fn change_three(service: Service) {
    let changed = service.update(&CALL, update(&[], &["changed"])).await;
    assert_eq!(changed.unwrap().updated_count, 1);
}

async fn remove_three(service: Service) {
    let removed = service.remove(&CALL, removal(&[3])).await;
    assert_eq!(removed.unwrap().removed_count, 1);
}

/// A mutation that read points before it had the writer uses their newest content.
#[tokio::test]
async fn a_mutation_sees_what_changed_while_it_read() {
    let again = async |service: Service| service.insert(&CALL, first_points(4)).await;
    let (_, refused) = overtaken(again, change_three).await;
    assert!(matches!(refused, Err(Error::PointsExist { ids, .. }) if ids == [3]));
    let (_, inserted) = overtaken(again, remove_three).await;
    let [unchanged, inserted_again] =
        [v1::Outcome::Unchanged, v1::Outcome::Inserted].map(i32::from);
    let outcomes = [unchanged, unchanged, unchanged, inserted_again];
    assert_eq!(inserted.unwrap().outcomes, outcomes);

    let tag = async |service: Service| service.update(&CALL, update(&[7], &[])).await;
    let (service, tagged) = overtaken(tag, change_three).await;
    assert_eq!(tagged.unwrap().updated_count, 1);
    let points = service.get(&CALL, getting(&[3])).await.unwrap().points;
    let points = points.unwrap();
    assert_eq!((&*points.payloads[0], points.tags[0]), (&b"changed"[..], 7));
    let (_, missing) = overtaken(tag, remove_three).await;
    assert!(matches!(missing, Err(Error::PointsNotFound { ids, .. }) if ids == [3]));
    let compare = async |service: Service| {
        let uid = info(&service, "arm").await.revision.uid();
        let request = v1::UpdateRequest {
            if_revision: revision(&uid, 1),
            uid,
            ..update(&[7], &[])
        };
        service.update(&CALL, request).await
    };
    let (_, conflict) = overtaken(compare, change_three).await;
    assert!(matches!(conflict, Err(Error::RevisionConflict { ids, .. }) if ids == [3]));
}

/// The neighbours include points that were inserted after the call began, and points that are near only after a
/// removal.
#[tokio::test]
async fn an_insert_answers_with_the_payloads_of_its_final_neighbours() {
    let insert = async |service: Service| {
        let request = v1::InsertRequest {
            neighbor_spec: neighbor_payloads(2),
            ..insertion(&[[3.1]], &[])
        };
        let neighbors = service.insert(&CALL, request).await?.neighbors.unwrap();
        Ok((neighbors.ids, neighbors.payloads))
    };
    let answer = overtaken(insert, change_three).await.1.unwrap();
    assert_eq!(answer, (vec![3, 4], vec!["changed".into(), payload(4)]));
    let answer = overtaken(insert, remove_three).await.1.unwrap();
    assert_eq!(answer, (vec![4, 2], vec![payload(4), payload(2)]));
    let add = async |service: Service| {
        let request = v1::InsertRequest {
            payloads: vec!["near".into()],
            ..insertion(&[[3.2]], &[50])
        };
        service.insert(&CALL, request).await.unwrap();
    };
    let answer = overtaken(insert, add).await.1.unwrap();
    assert_eq!(answer, (vec![3, 50], vec![payload(3), "near".into()]));
}

/// The update ends although other writers commit more than the cache of records holds during each read.
#[tokio::test]
async fn an_update_that_others_overtake_again_and_again_ends() {
    let (log, _) = ten_points().await;
    let service = serving_without_cache(&log, Limits::default());
    let updating = service.clone();
    let update =
        tokio::spawn(async move { updating.update(&CALL, update(&[], &["changed"])).await });
    let mut overtaken = 0;
    while !update.is_finished() {
        let others = [[100.0], [101.0]].map(async |row| {
            let inserted = service.insert(&CALL, insertion(&[row], &[])).await;
            inserted.unwrap();
        });
        join_all(others).await;
        overtaken += 1;
        assert!(overtaken < 5_000, "the update starves");
    }
    assert_eq!(update.await.unwrap().unwrap().updated_count, 1);
}

/// An insert's answer lacks the payloads that the insert replaces, although its rows found them before the comparison.
#[tokio::test]
async fn an_overtaken_insert_is_not_charged_for_the_payloads_that_it_replaces() {
    let log = FaultLog::new(0);
    let limits = Limits {
        max_answer_bytes: 2000,
        ..Limits::default()
    };
    let service = serving_without_cache(&log, limits);
    create(&service, "arm", "R1").await;
    let pair = |payload: &'static [u8]| v1::InsertRequest {
        payloads: vec![payload.into(); 2],
        ..insertion(&[[3.0], [4.0]], &[3, 4])
    };
    let large = &[7; 1500];
    service.insert(&CALL, pair(large)).await.unwrap();

    log.gate().close();
    let request = v1::InsertRequest {
        on_conflict: v1::OnConflict::Replace.into(),
        neighbor_spec: neighbor_payloads(1),
        ..pair(b"small")
    };
    let mut inserting = Box::pin(service.insert(&CALL, request));
    until_it_reads(&log, &mut inserting).await;
    log.gate().open();
    // The cache of records holds less than this, so the insert reads again.
    for x in [100.0, 101.0] {
        service.insert(&CALL, insertion(&[[x]], &[])).await.unwrap();
    }
    let neighbors = inserting.await.unwrap().neighbors.unwrap();
    assert_eq!(neighbors.ids, [4, 3]);
    assert_eq!(neighbors.payloads, [&large[..], b"small"]);
}

/// Changes the point 3, or compares it with an equal row.
type Overtaken = fn(Service) -> BoxFuture<'static, Result<(), Error>>;

const OVERTAKEN: [(&str, Overtaken); 2] = [
    ("Update", |service| {
        Box::pin(async move {
            let answer = service.update(&CALL, update(&[], &["changed"])).await?;
            assert_eq!(answer.updated_count, 1);
            Ok(())
        })
    }),
    ("Insert", |service| {
        Box::pin(async move {
            let again = v1::InsertRequest {
                payloads: vec![payload(3)],
                ..insertion(&[[3.0]], &[3])
            };
            let outcomes = service.insert(&CALL, again).await?.outcomes;
            assert_eq!(outcomes, [i32::from(v1::Outcome::Unchanged)]);
            Ok(())
        })
    }),
];

/// Writers overtake three reads of a mutation. The fourth holds the writer: they wait for it, and searches do not.
#[tokio::test]
async fn only_the_fourth_read_of_an_overtaken_mutation_holds_the_writer() {
    for (name, call) in OVERTAKEN {
        println!("{name}");
        let (log, _) = ten_points().await;
        let service = serving_without_cache(&log, Limits::default());
        log.gate().close();
        let call = tokio::spawn(call(service.clone()));
        for _ in 0..3 {
            log.gate().holds_a_read().await;
            for x in [100.0, 101.0] {
                service.insert(&CALL, insertion(&[[x]], &[])).await.unwrap();
            }
            log.gate().release();
        }
        log.gate().holds_a_read().await;
        let mut waiting = Box::pin(service.insert(&CALL, insertion(&[[102.0]], &[])));
        assert!(poll!(&mut waiting).is_pending());
        answer_others(&service, false).await;
        assert!(poll!(&mut waiting).is_pending());
        log.gate().open();
        call.await.unwrap().unwrap();
        assert_eq!(waiting.await.unwrap().ids.len(), 1);
    }
}
