//! Snapshots with integers that no honest client sends, and with right digests.

use prost::Message;
use prost_reflect::{DynamicMessage, Value};
use sha2::{Digest, Sha256};
use wayfold_proto::{
    snapshot::{Header, Writer},
    v1,
};

use crate::extremes::{EXTREMES, pool, variants};

/// The messages of calls of `RestoreIndex`, each call with a text that identifies it and an index of its own. The first call is
/// good. Each other one has an extreme in one integer of one part, or random integers in several.
pub(crate) fn restores() -> Vec<(String, Vec<v1::RestoreIndexRequest>)> {
    let content = pool().get_message_by_name("wayfold.v1.SnapshotContent");
    let read = |part: v1::SnapshotPart| {
        DynamicMessage::decode(content.clone().unwrap(), part.content).unwrap()
    };
    let good = parts().map(read);
    let mut snapshots = vec![("a good snapshot".to_owned(), good.clone())];
    for at in 0..good.len() {
        let (kind, message) = good[at].fields().next().unwrap();
        for (what, variant) in variants(message.as_message().unwrap()) {
            let mut snapshot = good.clone();
            snapshot[at].set_field(&kind, Value::Message(variant));
            snapshots.push((what, snapshot));
        }
    }
    let snapshots = snapshots.into_iter().enumerate();
    let mut restores: Vec<_> = snapshots
        .map(|(at, (what, contents))| (what, restore(format!("restored-{at}"), &contents)))
        .collect();
    for extreme in EXTREMES {
        let mut requests = restore(format!("numbered-{extreme}"), &good);
        requests[0].part.as_mut().unwrap().number = extreme;
        restores.push((format!("part {extreme}"), requests));
    }
    restores
}

/// A good snapshot, with a part of each kind.
fn parts() -> [v1::SnapshotPart; 4] {
    let mut writer = Writer::new();
    let header = Header {
        name: "arm".into(),
        uid: "of the first".into(),
        space: "R1".parse().unwrap(),
        payload_encoding: Default::default(),
        revision: 5,
        next_id: 10,
        point_count: 1,
    };
    let points = v1::SnapshotPoints {
        points: Some(v1::Points {
            ids: vec![1],
            states: Some(v1::States {
                row_count: 1,
                coordinates: vec![0.5],
            }),
            tags: vec![1],
            revisions: vec![2],
            payloads: vec![b"payload".as_slice().into()],
        }),
        modified_revisions: vec![4],
    };
    let sessions = v1::SnapshotSessions {
        sessions: vec![v1::SnapshotSession {
            session: 3,
            batch: 1,
            fingerprint: vec![7; 32],
            response: v1::WriteResponse::default().encode_to_vec(),
            time_ms: 1,
        }],
        blocks: vec![v1::SnapshotBlock {
            first_id: 4,
            id_count: 2,
            session: 3,
        }],
    };
    [
        writer.header(&header),
        writer.points(points),
        writer.sessions(sessions),
        writer.trailer(),
    ]
}

/// The messages that restore an index of this name from the contents of parts.
fn restore(name: String, contents: &[DynamicMessage]) -> Vec<v1::RestoreIndexRequest> {
    let mut digest = [0; 32];
    let parts = (1_u64..).zip(contents).map(|(number, content)| {
        let content = content.encode_to_vec();
        let chained = Sha256::new()
            .chain_update(digest)
            .chain_update(number.to_le_bytes())
            .chain_update(&content);
        digest = chained.finalize().into();
        v1::SnapshotPart {
            number,
            content: content.into(),
            digest: digest.to_vec().into(),
        }
    });
    let request = |part| v1::RestoreIndexRequest {
        name: name.clone(),
        part: Some(part),
    };
    parts.map(request).collect()
}
