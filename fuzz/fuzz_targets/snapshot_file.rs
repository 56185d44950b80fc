//! Snapshot files: raw bytes, and parts of any content whose digests match.
#![no_main]

use bytes::Bytes;
use libfuzzer_sys::fuzz_target;
use sha2::{Digest as _, Sha256};
use wayfold_proto::{
    snapshot::{Digest, FileWriter, Header, Reader, Writer, check},
    v1::SnapshotPart,
};

fuzz_target!(|bytes: &[u8]| {
    let _ = check(bytes);
    let Some((&points, contents)) = bytes.split_first() else {
        return;
    };
    let mut parts = Parts::default();
    if points > 0 {
        // A random header is rarely valid; a good one lets the target reach the points.
        let header = Writer::new().header(&Header {
            name: "arm".into(),
            uid: "00000000-0000-4000-8000-000000000000".into(),
            space: "R2".parse().expect("a space"),
            revision: 9,
            next_id: 100,
            point_count: u64::from(points) - 1,
            payload_encoding: Default::default(),
        });
        parts.push(header.content);
    }
    let mut rest = contents;
    while let Some((&length, after)) = rest.split_first() {
        let (content, after) = after.split_at(after.len().min(length.into()));
        parts.push(Bytes::copy_from_slice(content));
        rest = after;
    }
    let mut reader = Reader::new();
    let good = parts.0.iter().all(|part| reader.read(part).is_ok());
    let mut file = FileWriter::new(Vec::new());
    for part in &parts.0 {
        file.write(part).expect("memory");
    }
    let file = file.finish().expect("memory");
    assert_eq!(check(&*file).is_ok(), good && reader.finish().is_ok());
});

/// Parts of a snapshot, each with the number and the digest that it should have.
#[derive(Default)]
struct Parts(Vec<SnapshotPart>);

impl Parts {
    fn push(&mut self, content: Bytes) {
        let before = self
            .0
            .last()
            .map_or(Bytes::from_static(&[0; 32]), |part| part.digest.clone());
        let number = self.0.len() as u64 + 1;
        let digest: Digest = Sha256::new()
            .chain_update(before)
            .chain_update(number.to_le_bytes())
            .chain_update(&content)
            .finalize()
            .into();
        self.0.push(SnapshotPart {
            number,
            content,
            digest: Bytes::copy_from_slice(&digest),
        });
    }
}
