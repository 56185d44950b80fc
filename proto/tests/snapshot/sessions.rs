//! Writer sessions in snapshots: a reader returns the written ones, and refuses those that no index holds. Snapshots of
//! version 2, which have none, are read.

use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use prost::Message;
use wayfold_proto::snapshot::{Content, FileReader, Header, Reader, SnapshotError, Writer, check};
use wayfold_proto::v1;

use super::{file, signed};

const REVISION: u64 = 90;
const NEXT_ID: u64 = 1000;

fn header(point_count: u64) -> Header {
    Header {
        space: "R1".parse().unwrap(),
        revision: REVISION,
        next_id: NEXT_ID,
        ..super::header(point_count)
    }
}

fn point() -> v1::SnapshotPoints {
    v1::SnapshotPoints {
        points: Some(v1::Points {
            ids: vec![7],
            states: Some(v1::States {
                row_count: 1,
                coordinates: vec![0.5],
            }),
            tags: vec![0],
            revisions: vec![4],
            payloads: Vec::new(),
        }),
        modified_revisions: vec![4],
    }
}

fn session(session: u64) -> v1::SnapshotSession {
    let response = v1::WriteResponse {
        missing_count: session,
        ..Default::default()
    };
    v1::SnapshotSession {
        session,
        batch: 3,
        fingerprint: vec![session as u8; 32],
        response: response.encode_to_vec(),
        time_ms: 1000 * session,
    }
}

fn block(first_id: u64, id_count: u64, session: u64) -> v1::SnapshotBlock {
    v1::SnapshotBlock {
        first_id,
        id_count,
        session,
    }
}

/// Two sessions with three blocks.
fn two() -> v1::SnapshotSessions {
    v1::SnapshotSessions {
        sessions: vec![session(1), session(REVISION)],
        blocks: vec![block(0, 5, REVISION), block(5, 1, 1), block(20, 980, 1)],
    }
}

/// A snapshot of one point and these parts of sessions.
fn parts(pages: &[v1::SnapshotSessions]) -> Vec<v1::SnapshotPart> {
    let mut writer = Writer::new();
    let mut parts = vec![writer.header(&header(1)), writer.points(point())];
    parts.extend(pages.iter().map(|page| writer.sessions(page.clone())));
    parts.push(writer.trailer());
    parts
}

/// The contents of a sound file.
fn contents(bytes: &[u8]) -> Vec<Content> {
    let mut file = FileReader::new(bytes).unwrap();
    let next = || file.next_part().unwrap().map(|(_, content)| content);
    std::iter::from_fn(next).collect()
}

fn refusal(parts: &[v1::SnapshotPart]) -> SnapshotError {
    let mut reader = Reader::new();
    let read = parts
        .iter()
        .try_for_each(|part| reader.read(part).map(drop));
    read.unwrap_err()
}

/// The refusal of the two sessions with one thing changed, all digests good.
fn refusal_of(change: impl FnOnce(&mut v1::SnapshotSessions)) -> SnapshotError {
    let mut page = two();
    change(&mut page);
    refusal(&parts(&[page]))
}

#[test]
fn sessions_that_no_index_holds_are_refused_with_their_place() {
    type Change = fn(&mut v1::SnapshotSessions);
    let cases: [(Change, &str); 14] = [
        (
            |it| it.sessions[1].session = 1,
            "part 3, session 1: it follows session 1",
        ),
        (|it| it.sessions[0].session = 0, "session 0: a session is"),
        (
            |it| it.sessions[1].session = REVISION + 1,
            "session 91: a session is the number of a revision, from 1 to 90",
        ),
        (
            |it| it.sessions[1].fingerprint.truncate(31),
            "session 90: its fingerprint has 31 bytes",
        ),
        (
            |it| it.sessions[1].response = vec![0xff],
            "session 90: its response is not a WriteResponse",
        ),
        (
            // An unknown field of 300 bytes.
            |it| it.sessions[1].response = [&[0x7a, 172, 2][..], &[0; 300]].concat(),
            "session 90: its response is not a WriteResponse",
        ),
        (
            |it| it.sessions = vec![v1::SnapshotSession::default(); 100],
            "103 entries in ",
        ),
        (
            |it| it.blocks[1].id_count = 0,
            "part 3, block of ids from 5: it holds no id",
        ),
        (|it| it.blocks[1].first_id = 4, "before ends before id 5"),
        (|it| it.blocks.swap(1, 2), "from 5: the block before ends"),
        (|it| it.blocks[2].id_count = 981, "next_id, which is 1000"),
        (
            |it| it.blocks[2].id_count = u64::MAX,
            "next_id, which is 1000",
        ),
        (|it| it.blocks[2].session = 2, "session 2 reserved it"),
        (
            |it| *it = v1::SnapshotSessions::default(),
            "sessions without any session or block",
        ),
    ];
    for (change, words) in cases {
        let error = refusal_of(change);
        assert!(error.to_string().contains(words), "{error}");
        assert_eq!(error.reason(), "SNAPSHOT_INVALID");
    }
}

#[test]
fn parts_in_another_order_are_refused() {
    let mut pages = [two(), two()];
    pages[0].blocks.clear();
    pages[1].sessions.clear();
    assert_eq!(check(&file(&parts(&pages))[..]).unwrap(), header(1));
    pages.swap(0, 1);
    let unknown = refusal(&parts(&pages)).to_string();
    assert!(unknown.contains("session 90 reserved it"), "{unknown}");
    pages[0] = two();
    pages[1] = v1::SnapshotSessions {
        sessions: vec![session(91)],
        blocks: Vec::new(),
    };
    let after = refusal(&parts(&pages)).to_string();
    assert!(after.contains("a session after a block"), "{after}");

    let mut writer = Writer::new();
    let late = [
        writer.header(&header(1)),
        writer.sessions(two()),
        writer.points(point()),
    ];
    let late = refusal(&late).to_string();
    assert!(late.contains("points after the writer sessions"), "{late}");
    let first = refusal(&[Writer::new().sessions(two())]).to_string();
    assert!(first.contains("begins with its header"), "{first}");
}

#[test]
fn the_trailer_counts_sessions_and_blocks() {
    let good = parts(&[two()]);
    let trailer = |session_count, block_count| {
        let trailer = v1::SnapshotTrailer {
            point_count: 1,
            session_count,
            block_count,
        };
        let kind = Some(v1::snapshot_content::Kind::Trailer(trailer));
        let content = v1::SnapshotContent { kind }.encode_to_vec();
        signed(&good[2].digest, 4, content)
    };
    assert_eq!(trailer(2, 3), good[3]);
    for (sessions, blocks, words) in [
        (1, 3, "2 sessions so far, where the trailer says 1"),
        (2, 4, "3 blocks so far, where the trailer says 4"),
    ] {
        let mut parts = good.clone();
        parts[3] = trailer(sessions, blocks);
        let error = refusal(&parts).to_string();
        assert!(error.contains(words), "{error}");
    }
}

#[test]
fn every_flipped_bit_and_every_cut_is_noticed() {
    let bytes = file(&parts(&[two()]));
    for bit in 0..8 * bytes.len() {
        let mut flipped = bytes.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        assert!(check(&flipped[..]).is_err(), "bit {bit}");
    }
    for end in 0..bytes.len() {
        assert!(check(&bytes[..end]).is_err(), "{end} bytes");
    }
}

/// A server wrote this file before there were sessions: four revisions of an index of two points.
const VERSION_2: &[u8] = include_bytes!("../version-2.snapshot");

#[test]
fn a_snapshot_of_version_2_is_read_and_written_again() {
    let contents = contents(VERSION_2);
    let [
        Content::Header(header),
        Content::Points(points, modified),
        Content::Trailer,
    ] = &contents[..]
    else {
        panic!("{contents:?}");
    };
    assert_eq!((&*header.name, header.revision), ("arm", 4));
    assert_eq!((header.next_id, header.point_count), (11, 2));
    assert_eq!((&points.ids[..], &modified[..]), (&[0, 1][..], &[1, 3][..]));
    let payloads = ["grasp", "retract"].map(|text| text.as_bytes().to_vec());
    assert_eq!(points.payloads, payloads);

    // A program that copies the parts writes the same file.
    let mut reader = FileReader::new(VERSION_2).unwrap();
    let mut parts = Vec::new();
    while let Some((part, _)) = reader.next_part().unwrap() {
        parts.push(part);
    }
    assert_eq!(file(&parts), VERSION_2);

    let kind = Some(v1::snapshot_content::Kind::Sessions(two()));
    let content = v1::SnapshotContent { kind }.encode_to_vec();
    parts[2] = signed(&parts[1].digest, 3, content);
    let error = refusal(&parts).to_string();
    assert!(
        error.contains("version 2 has no writer sessions"),
        "{error}"
    );
}

#[test]
fn the_versions_of_the_file_and_of_its_header_are_the_same() {
    for (bytes, line) in [(VERSION_2, '3'), (&file(&parts(&[]))[..], '2')] {
        let mut bytes = bytes.to_vec();
        bytes["wayfold snapshot ".len()] = line as u8;
        let error = check(&bytes[..]).unwrap_err().to_string();
        let words = format!("where the first line says {line}");
        assert!(error.contains(&words), "{error}");
    }
}

/// Sessions and blocks that an index may hold.
fn sessions() -> impl Strategy<Value = v1::SnapshotSessions> {
    let ids = prop::collection::btree_set(1..=REVISION, 1..30);
    let outcome = (any::<u64>(), any::<[u8; 32]>(), any::<u64>());
    let outcomes = prop::collection::vec(outcome, 30);
    let bounds = prop::collection::btree_set(0..=NEXT_ID, 0..40);
    let owners = prop::collection::vec(any::<prop::sample::Index>(), 20);
    (ids, outcomes, bounds, owners).prop_map(|(ids, outcomes, bounds, owners)| {
        let sessions = ids.into_iter().zip(outcomes);
        let sessions = sessions.map(|(id, (batch, fingerprint, time_ms))| v1::SnapshotSession {
            batch,
            fingerprint: fingerprint.to_vec(),
            time_ms,
            ..session(id)
        });
        let sessions: Vec<_> = sessions.collect();
        let bounds: Vec<u64> = bounds.into_iter().collect();
        let blocks = bounds.chunks_exact(2).zip(owners);
        let blocks = blocks.map(|(bounds, owner)| {
            let owner = sessions[owner.index(sessions.len())].session;
            block(bounds[0], bounds[1] - bounds[0], owner)
        });
        let blocks = blocks.collect();
        v1::SnapshotSessions { sessions, blocks }
    })
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 300,
        failure_persistence: None,
        rng_seed: RngSeed::Fixed(17),
        ..ProptestConfig::default()
    })]

    /// In parts of any sizes.
    #[test]
    fn written_sessions_are_read(all in sessions(), most in 1..12_usize) {
        let sessions = all.sessions.chunks(most).map(|sessions| v1::SnapshotSessions {
            sessions: sessions.to_vec(),
            blocks: Vec::new(),
        });
        let blocks = all.blocks.chunks(most).map(|blocks| v1::SnapshotSessions {
            sessions: Vec::new(),
            blocks: blocks.to_vec(),
        });
        let pages: Vec<_> = sessions.chain(blocks).collect();
        for pages in [&pages[..], &[all]] {
            let contents = contents(&file(&parts(pages)));
            let expected = pages.iter().cloned().map(Content::Sessions);
            prop_assert_eq!(&contents[2..contents.len() - 1], &expected.collect::<Vec<_>>()[..]);
        }
    }

    /// A good header, then damaged sessions with a good digest.
    #[test]
    fn damaged_sessions_with_a_good_digest_do_not_make_a_reader_panic(
        at in any::<prop::sample::Index>(),
        bytes in prop::collection::vec(any::<u8>(), 1..8),
    ) {
        let good = parts(&[two()]);
        let mut content = good[2].content.to_vec();
        let start = at.index(content.len());
        for (place, byte) in content[start..].iter_mut().zip(bytes) {
            *place = byte;
        }
        let Ok(content) = v1::SnapshotContent::decode(&content[..]) else {
            return Ok(());
        };
        let mut reader = Reader::new();
        reader.read(&good[0]).unwrap();
        reader.read(&good[1]).unwrap();
        let _ = reader.read(&signed(&good[1].digest, 3, content.encode_to_vec()));
    }
}
