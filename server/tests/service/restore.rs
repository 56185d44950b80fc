//! Restored indices answer like the source of the snapshot; a failed restore leaves nothing.

mod room;

use std::sync::Arc;

use bytes::Bytes;
use prost::Message;
use wayfold_index::Space;
use wayfold_proto::{
    snapshot::{Header, Writer},
    v1,
};
use wayfold_server::{
    log::{Durability, FjallLog, Log, MemoryLog},
    service::{Code, Service},
};

use crate::{
    copied::copied,
    support::{snapshots::*, *},
};

const SPACES: [&str; 5] = ["R1", "SO2[1]", "R2*SO2", "R3*SO3:0.15", "sum(R2, SO3)"];

/// The encoded answers of all reads of `arm`, for comparisons to the last bit.
async fn answers(service: &Service, space: &Space) -> Vec<Vec<u8>> {
    let index = info(service, "arm").await;
    let (uid, newest) = (index.revision.uid(), index.revision.number());
    let mut rows = vec![0.25; space.coordinates()];
    if space.to_string().contains("SO3") {
        let start = space.coordinates() - 4;
        rows[start..].copy_from_slice(&[0.5, 0.5, -0.5, 0.5]);
    }
    let include = v1::Include {
        with_states: true,
        with_tags: true,
        with_revisions: true,
        with_payloads: true,
    };
    let mut answers = Vec::new();
    for since in [0, newest / 2, newest - 1] {
        let filter = v1::Filter {
            since_revision: revision(&uid, since),
            ..Default::default()
        };
        let min_revision = revision(&uid, newest);
        let knn = v1::KnnRequest {
            index_name: "arm".into(),
            states: Some(v1::States {
                row_count: 1,
                coordinates: rows.clone(),
            }),
            k_form: nearest(1000).map(Into::into),
            filter: Some(filter.clone()),
            include: Some(include),
            min_revision: min_revision.clone(),
            ..Default::default()
        };
        let query = v1::QueryRequest {
            index_name: "arm".into(),
            states: knn.states.clone(),
            radius_form: within(0.75),
            filter: Some(filter),
            include: Some(include),
            min_revision,
            ..Default::default()
        };
        let mut knn = service.knn(&CALL, knn).await.unwrap();
        let mut query = service.query(&CALL, query).await.unwrap();
        (knn.revision, query.revision) = (numbered(&knn.revision), numbered(&query.revision));
        answers.extend([knn.encode_to_vec(), query.encode_to_vec()]);
    }
    let mut scanned = everything(service).await;
    let ids = scanned.points.as_ref().unwrap().ids.clone();
    let mut got = service.get(&CALL, getting(&ids)).await.unwrap();
    (scanned.revision, got.revision) = (numbered(&scanned.revision), numbered(&got.revision));
    answers.extend([scanned.encode_to_vec(), got.encode_to_vec()]);
    answers
}

/// The revision without the uid: a restored index has a new uid.
fn numbered(named: &Option<v1::Revision>) -> Option<v1::Revision> {
    revision("", named.number())
}

/// The same calls on both have the same effects, because both know the same used ids and the revision that changed each
/// point.
async fn go_on(service: &Service, space: &Space) -> Vec<Vec<u8>> {
    let ids = everything(service).await.points.unwrap().ids;
    let index = info(service, "arm").await;
    let mut encoded = Vec::new();
    for if_revision in 0..=index.revision.number() {
        let update = v1::UpdateRequest {
            tags: vec![if_revision],
            if_revision: revision(&index.revision.uid(), if_revision),
            ..updating(&ids)
        };
        // The error names the points that changed later.
        encoded.push(match service.update(&CALL, update).await {
            Ok(updated) => updated.updated_count.to_string().into_bytes(),
            Err(error) => error.to_string().into_bytes(),
        });
    }
    let mut row = vec![0.0; space.coordinates()];
    if space.to_string().contains("SO3") {
        row[space.coordinates() - 1] = 1.0;
    }
    let insert = v1::InsertRequest {
        index_name: "arm".into(),
        states: Some(v1::States {
            row_count: 1,
            coordinates: row,
        }),
        ..Default::default()
    };
    let mut inserted = service.insert(&CALL, insert).await.unwrap();
    inserted.revision = numbered(&inserted.revision);
    encoded.push(inserted.encode_to_vec());
    encoded.extend(answers(service, space).await);
    encoded
}

#[tokio::test]
async fn a_restored_index_answers_as_the_other_did_and_goes_on_as_it_does() {
    for (seed, space) in SPACES.into_iter().enumerate() {
        println!("space {space}, seed {seed}");
        let directory = tempfile::tempdir().unwrap();
        let disk = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
        let logs = [Log::from(Arc::new(MemoryLog::new())), Arc::new(disk).into()];
        let mut crashed = None;
        for log in logs {
            let source = service();
            lived_in(&source, space, seed as u64).await;
            let space: Space = space.parse().unwrap();
            let parts = snapshot(&source, "arm").await;
            let target = over(log);
            let restored = restore(&target, "arm", &parts).await.unwrap();
            let original = info(&source, "arm").await;
            assert_ne!(restored.revision.uid(), original.revision.uid());
            assert_eq!(settled(restored.clone()), described(&target, "arm").await);
            let same = |index: v1::Index| v1::Index {
                revision: numbered(&index.revision),
                memory_bytes: 0,
                ..index
            };
            assert_eq!(same(restored), same(original));
            assert_eq!(
                answers(&target, &space).await,
                answers(&source, &space).await
            );
            let report = |service| verify(service, verification());
            let (one, other) = (
                report(&target).await.unwrap(),
                report(&source).await.unwrap(),
            );
            assert_eq!((one.disagreement_count, other.disagreement_count), (0, 0));
            assert_eq!(one.content_hash, other.content_hash);

            // A copy of the copy has the same content.
            let again = read(&snapshot(&target, "arm").await);
            let first = read(&parts);
            assert_eq!((again.ids, again.points), (first.ids, first.points));
            let copy = copied(directory.path());
            let gone_on = go_on(&source, &space).await;
            assert_eq!(go_on(&target, &space).await, gone_on);
            crashed = Some((copy, gone_on));
        }
        // After a crash, the copy on disk answers the same.
        let (crashed, gone_on) = crashed.unwrap();
        let log = FjallLog::open(crashed.path(), Durability::Fsync).unwrap();
        let service = restarted(Arc::new(log));
        let report = verify(&service, verification()).await.unwrap();
        assert_eq!(report.disagreement_count, 0);
        assert!(report.stored_point_count > 0);
        restore(&service, "copy", &snapshot(&service, "arm").await)
            .await
            .unwrap();
        let space: Space = space.parse().unwrap();
        assert_eq!(go_on(&service, &space).await, gone_on);
    }
}

#[tokio::test]
async fn an_index_without_points_is_restored() {
    let (source, _) = arm("SO3").await;
    insert_rows(&source, &[[0.0, 0.0, 0.0, 1.0]], &[7]).await;
    source.remove(&CALL, removal(&[7])).await.unwrap();
    create(&source, "fresh", "R1").await;
    let target = service();
    for (name, revision) in [("arm", 2), ("fresh", 0)] {
        let parts = snapshot(&source, name).await;
        let index = restore(&target, name, &parts).await.unwrap();
        assert_eq!((index.revision.number(), index.point_count), (revision, 0));
    }
    let inserted = target
        .insert(&CALL, insertion(&[[0.0, 0.0, 0.0, 1.0]], &[]))
        .await;
    let inserted = inserted.unwrap();
    assert_eq!((inserted.ids, inserted.revision.number()), (vec![8], 3));
}

#[tokio::test]
async fn a_name_that_is_taken_is_refused_first_and_last() {
    let source = service();
    lived_in(&source, "R1", 1).await;
    let parts = snapshot(&source, "arm").await;
    let before = described(&source, "arm").await;
    let refused = refusal(restore(&source, "arm", &parts[..1]).await);
    assert_eq!(
        (refused.0, refused.1),
        (Code::AlreadyExists, "INDEX_EXISTS")
    );
    assert_eq!(described(&source, "arm").await, before);

    // The first of two concurrent restores to end gets the name.
    let target = service();
    let mut both = [
        target.restore_index(&CALL).unwrap(),
        target.restore_index(&CALL).unwrap(),
    ];
    for part in &parts {
        for restoring in &mut both {
            let (name, part) = ("leg".into(), Some(part.clone()));
            restoring
                .add(v1::RestoreIndexRequest { name, part })
                .await
                .unwrap();
        }
    }
    let [one, other] = both;
    let index = other.finish().await.unwrap().index.unwrap();
    assert_eq!(refusal(one.finish().await).0, Code::AlreadyExists);
    assert_eq!(described(&target, "leg").await, settled(index));
}

/// Asserts that a failed restore left no index and, once its remains are swept, no trace in the log.
async fn is_untouched(service: &Service, log: &Log) {
    let page = v1::ListIndexesRequest::default();
    let listed = service.list_indexes(&CALL, page).await.unwrap();
    assert_eq!(listed.indexes, Vec::new());
    assert_eq!(log.catalogue.indexes().unwrap(), Vec::new());
}

#[tokio::test]
async fn an_incomplete_restore_leaves_nothing() {
    let source = service();
    create(&source, "arm", "R3").await;
    for seed in 0..4 {
        insert_rows(&source, &cube(seed, 4000), &[]).await;
    }
    let parts = snapshot(&source, "arm").await;
    assert!(parts.len() > 4);
    let directory = tempfile::tempdir().unwrap();
    let disk = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
    let logs = [Log::from(Arc::new(MemoryLog::new())), Arc::new(disk).into()];
    for log in logs {
        let target = over(log.clone());
        for end in 0..parts.len() {
            let cut = restore(&target, "arm", &parts[..end]).await;
            let (code, reason, field) = refusal(cut);
            let expected = (Code::InvalidArgument, "SNAPSHOT_CUT_SHORT", "part");
            assert_eq!((code, reason, &*field), expected, "after {end} parts");
            is_untouched(&target, &log).await;

            // A restore that its caller cancels.
            let mut given_up = target.restore_index(&CALL).unwrap();
            for part in &parts[..end] {
                let (name, part) = ("arm".into(), Some(part.clone()));
                let message = v1::RestoreIndexRequest { name, part };
                given_up.add(message).await.unwrap();
            }
            drop(given_up);
            is_untouched(&target, &log).await;
        }
        for at in 0..parts.len() {
            let mut damaged = parts.clone();
            let mut content = damaged[at].content.to_vec();
            let middle = content.len() / 2;
            content[middle] ^= 4;
            damaged[at].content = content.into();
            let error = restore(&target, "arm", &damaged).await.unwrap_err();
            assert_eq!(error.code(), Code::InvalidArgument);
            assert_eq!(error.reason(), "SNAPSHOT_DAMAGED");
            let place = format!("part: part {} does not match", at + 1);
            assert!(error.to_string().starts_with(&place), "{error}");
            is_untouched(&target, &log).await;
        }
        // The name stays free.
        restore(&target, "arm", &parts).await.unwrap();
        assert_eq!(info(&target, "arm").await.point_count, 16_000);
    }
}

#[tokio::test]
async fn parts_that_no_server_writes_are_refused() {
    let target = service();
    let header = Header {
        name: "arm".into(),
        uid: String::new(),
        space: "R1".parse().unwrap(),
        revision: 5,
        next_id: 9,
        point_count: 1,
        payload_encoding: Default::default(),
    };
    let point = |id, revision, modified, x| v1::SnapshotPoints {
        points: Some(v1::Points {
            ids: vec![id],
            states: states(&[[x]]),
            tags: vec![0],
            revisions: vec![revision],
            payloads: vec![Bytes::new()],
        }),
        modified_revisions: vec![modified],
    };
    for (points, words) in [
        (point(9, 1, 1, 0.0), "ids are below next_id"),
        (point(3, 6, 6, 0.0), "stored by revision 6"),
        (point(3, 1, 1, -0.0), "not in canonical form"),
        (point(3, 1, 1, f64::NAN), "none of the space"),
    ] {
        let mut writer = Writer::new();
        let parts = [
            writer.header(&header),
            writer.points(points),
            writer.trailer(),
        ];
        let error = restore(&target, "arm", &parts).await.unwrap_err();
        assert_eq!(error.code(), Code::InvalidArgument);
        assert!(error.to_string().contains(words), "{error}");
        assert!(error.to_string().contains("part 2, point 0"), "{error}");
    }
    let mut writer = Writer::new();
    let good = [
        writer.header(&header),
        writer.points(point(3, 1, 5, 0.5)),
        writer.trailer(),
    ];
    let refused = async |messages: &[(&str, Option<&v1::SnapshotPart>)]| {
        let mut restoring = target.restore_index(&CALL).unwrap();
        for (name, part) in messages {
            let (name, part) = ((*name).into(), part.cloned());
            if let Err(error) = restoring.add(v1::RestoreIndexRequest { name, part }).await {
                return refusal::<()>(Err(error));
            }
        }
        refusal(restoring.finish().await)
    };
    let all: Vec<_> = good.iter().map(|part| ("", Some(part))).collect();
    assert_eq!(refused(&all).await.2, "name");
    assert_eq!(refused(&[("Arm", Some(&good[0]))]).await.2, "name");
    let other = [("arm", Some(&good[0])), ("leg", Some(&good[1]))];
    assert_eq!(refused(&other).await.1, "AMBIGUOUS");
    assert_eq!(refused(&[("arm", None)]).await.1, "REQUIRED");
    let more = [all[0], all[1], all[2], all[2]].map(|(_, part)| ("arm", part));
    assert_eq!(refused(&more).await.1, "SNAPSHOT_TRAILING");
    assert_eq!(refused(&[]).await.1, "SNAPSHOT_CUT_SHORT");
    restore(&target, "arm", &good).await.unwrap();
}

#[tokio::test]
async fn a_server_that_stops_and_a_deadline_end_it() {
    let (source, _) = arm("R1").await;
    let parts = snapshot(&source, "arm").await;
    let past = wayfold_server::service::Call {
        deadline: Some(std::time::Instant::now()),
        ..Default::default()
    };
    let late = source.restore_index(&past);
    assert_eq!(refusal(late.map(drop)).0, Code::DeadlineExceeded);
    source.begin_shutdown();
    let stopping = restore(&source, "leg", &parts).await;
    assert_eq!(refusal(stopping).0, Code::Unavailable);
}
