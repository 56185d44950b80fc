//! Snapshots: a reader returns the written parts, detects every cut and every flipped bit, and never panics.

#![expect(clippy::unwrap_used, reason = "a test stops where its helper fails")]

mod arbitrary;
mod sessions;

use prost::Message;
use sha2::{Digest, Sha256};
use wayfold_proto::snapshot::{
    Content, FileReader, FileWriter, Header, PointProblem, Reader, SnapshotError, Writer, check,
};
use wayfold_proto::v1;

fn header(points: u64) -> Header {
    Header {
        name: "arm".into(),
        uid: "fe1a".into(),
        space: "R1*SO2".parse().unwrap(),
        revision: 9,
        next_id: 1000,
        point_count: points,
        payload_encoding: Default::default(),
    }
}

fn points(ids: &[u64]) -> v1::SnapshotPoints {
    let coordinates = ids.iter().flat_map(|&id| [id as f64, 0.5]);
    v1::SnapshotPoints {
        points: Some(v1::Points {
            ids: ids.into(),
            states: Some(v1::States {
                row_count: ids.len() as u32,
                coordinates: coordinates.collect(),
            }),
            tags: ids.iter().map(|id| id * 3).collect(),
            revisions: vec![4; ids.len()],
            payloads: ids.iter().map(|id| id.to_string().into()).collect(),
        }),
        modified_revisions: vec![6; ids.len()],
    }
}

/// The parts of a snapshot whose parts of points hold these ids.
fn parts(ids: &[Vec<u64>]) -> Vec<v1::SnapshotPart> {
    let mut writer = Writer::new();
    let total: usize = ids.iter().map(Vec::len).sum();
    let mut parts = vec![writer.header(&header(total as u64))];
    parts.extend(ids.iter().map(|ids| writer.points(points(ids))));
    parts.push(writer.trailer());
    parts
}

fn three_parts(header: &Header, points: v1::SnapshotPoints) -> [v1::SnapshotPart; 3] {
    let mut writer = Writer::new();
    let header = writer.header(header);
    [header, writer.points(points), writer.trailer()]
}

fn file(parts: &[v1::SnapshotPart]) -> Vec<u8> {
    let mut file = FileWriter::new(Vec::new());
    for part in parts {
        file.write(part).unwrap();
    }
    file.finish().unwrap()
}

fn whole() -> Vec<u8> {
    file(&parts(&[vec![1, 5, 6], vec![70, 999]]))
}

/// Fails with the error's text unless it is this variant.
macro_rules! assert_error {
    ($error:expr, $($variant:tt)+) => {
        let error = &$error;
        assert!(matches!(error, SnapshotError::$($variant)+), "{error}");
    };
}

/// The header of a snapshot with one thing changed, then such points, then a trailer, all with good digests.
fn read_changed(
    change_header: impl FnOnce(&mut Header),
    change: impl FnOnce(&mut v1::SnapshotPoints),
) -> SnapshotError {
    let mut header = header(3);
    change_header(&mut header);
    let mut points = points(&[1, 5, 6]);
    change(&mut points);
    let mut reader = Reader::new();
    let mut parts = three_parts(&header, points).into_iter();
    let read = parts.try_for_each(|part| reader.read(&part).map(drop));
    read.unwrap_err()
}

fn columns(points: &mut v1::SnapshotPoints) -> &mut v1::Points {
    points.points.as_mut().unwrap()
}

fn coordinates(points: &mut v1::SnapshotPoints) -> &mut Vec<f64> {
    &mut columns(points).states.as_mut().unwrap().coordinates
}

#[test]
fn a_written_snapshot_is_read_again() {
    assert_eq!(check(&file(&parts(&[]))[..]).unwrap(), header(0));
    let written = parts(&[vec![1, 5, 6], vec![70, 999]]);
    let bytes = file(&written);
    assert_eq!(check(&bytes[..]).unwrap(), header(5));
    let mut file = FileReader::new(&bytes[..]).unwrap();
    let mut contents = Vec::new();
    while let Some((part, content)) = file.next_part().unwrap() {
        assert_eq!(part, written[contents.len()]);
        contents.push(content);
    }
    let content = |ids: &[u64]| {
        let points = points(ids);
        Content::Points(points.points.unwrap(), points.modified_revisions)
    };
    let expected = [
        Content::Header(header(5)),
        content(&[1, 5, 6]),
        content(&[70, 999]),
        Content::Trailer,
    ];
    assert_eq!(contents, expected);
}

/// Another program reads the file as one line and delimited messages.
#[test]
fn a_file_is_a_line_and_delimited_messages() {
    let bytes = whole();
    let mut rest = bytes.strip_prefix(b"wayfold snapshot 3\n").unwrap();
    for written in parts(&[vec![1, 5, 6], vec![70, 999]]) {
        let part = v1::SnapshotPart::decode_length_delimited(&mut rest).unwrap();
        assert_eq!(part, written);
    }
    assert!(rest.is_empty());
}

#[test]
fn every_cut_is_noticed() {
    let bytes = whole();
    for end in 0..bytes.len() {
        let error = check(&bytes[..end]).unwrap_err();
        if end < "wayfold snapshot 3\n".len() {
            assert_error!(error, NotSnapshot);
        } else {
            assert_error!(error, CutShort { .. });
        }
    }
}

#[test]
fn every_flipped_bit_is_noticed() {
    let bytes = whole();
    for bit in 0..8 * bytes.len() {
        let mut flipped = bytes.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        assert!(check(&flipped[..]).is_err(), "bit {bit}");
    }
}

#[test]
fn bytes_after_the_trailer_are_noticed() {
    for more in [&b"\n"[..], b"\0", b"more", &whole()] {
        let bytes = [&whole()[..], more].concat();
        assert_error!(check(&bytes[..]).unwrap_err(), Trailing { part: 4 });
    }
    let mut reader = Reader::new();
    let parts = parts(&[]);
    reader.read(&parts[0]).unwrap();
    reader.read(&parts[1]).unwrap();
    assert_error!(reader.read(&parts[1]).unwrap_err(), Trailing { part: 2 });
}

#[test]
fn parts_that_are_missing_moved_or_doubled_are_noticed() {
    let parts = parts(&[vec![1], vec![2], vec![3]]);
    for from in 0..parts.len() {
        let mut missing = parts.clone();
        let part = missing.remove(from);
        let error = check(&file(&missing)[..]).unwrap_err();
        let expected = if from + 1 == parts.len() {
            matches!(error, SnapshotError::CutShort { parts: 4 })
        } else {
            matches!(error, SnapshotError::Order { part, found }
                if part == from as u64 + 1 && found == part + 1)
        };
        assert!(expected, "{from}: {error}");
        for to in 0..parts.len() {
            if from != to {
                let mut moved = missing.clone();
                moved.insert(to, part.clone());
                assert!(check(&file(&moved)[..]).is_err(), "{from} to {to}");
            }
            let mut doubled = parts.clone();
            doubled.insert(to, part.clone());
            assert!(check(&file(&doubled)[..]).is_err(), "{from} also at {to}");
        }
    }
}

/// The numbers of the parts fit, so only the digest shows the exchange.
#[test]
fn a_part_of_another_snapshot_is_noticed() {
    let (mut parts, others) = (parts(&[vec![1], vec![2]]), parts(&[vec![8], vec![2]]));
    parts[2] = others[2].clone();
    let error = check(&file(&parts)[..]).unwrap_err();
    assert_error!(error, Damaged { part: 3 });
    assert!(error.to_string().starts_with("part 3 "));
}

#[test]
fn other_files_and_other_versions_are_told_apart() {
    for other in [
        &b""[..],
        b"PK\x03\x04",
        b"id,x,y\n1,2,3\n",
        b"\x93NUMPY\x01\x00",
        &[0xff; 100],
    ] {
        assert_error!(check(other).unwrap_err(), NotSnapshot);
    }
    for version in [1, 4] {
        let file = format!("wayfold snapshot {version}\nwhatever");
        let error = check(file.as_bytes()).unwrap_err();
        let expected = format!("format version {version}");
        assert!(error.to_string().contains(&expected), "{error}");
    }

    // On a stream, the header holds the version.
    let content = v1::SnapshotContent {
        kind: Some(v1::snapshot_content::Kind::Header(v1::SnapshotHeader {
            format_version: 4,
            ..Default::default()
        })),
    };
    // The header of version 1: `format_version`, `uid` and the number of its revision.
    let first = b"\x0a\x0a\x08\x01\x1a\x04fe1a\x30\x09".to_vec();
    for (version, content) in [(4, content.encode_to_vec()), (1, first)] {
        let part = signed(&[0; 32], 1, content);
        let error = Reader::new().read(&part).unwrap_err();
        let expected = format!("format version {version}");
        assert!(error.to_string().contains(&expected), "{error}");
    }
}

/// The part with this content after the part with the digest `before`, its digest as documented.
fn signed(before: &[u8], number: u64, content: Vec<u8>) -> v1::SnapshotPart {
    let bytes = [before, &number.to_le_bytes(), &content].concat();
    v1::SnapshotPart {
        number,
        content: content.into(),
        digest: Sha256::digest(&bytes).to_vec().into(),
    }
}

#[test]
fn digests_are_as_documented() {
    let part = &parts(&[])[0];
    assert_eq!(*part, signed(&[0; 32], 1, part.content.to_vec()));
}

#[test]
fn points_that_no_index_holds_are_refused_with_their_place() {
    type Change = fn(&mut v1::SnapshotPoints);
    let cases: [(Change, &str); 10] = [
        (|p| columns(p).ids[1] = 1, "NotAscending"),
        (|p| columns(p).ids[2] = 2, "NotAscending"),
        (|p| columns(p).ids[2] = 1 << 63, "Id"),
        (|p| columns(p).revisions[2] = 7, "Revisions"),
        (|p| columns(p).revisions[2] = 0, "Revisions"),
        (|p| p.modified_revisions[2] = 10, "Revisions"),
        (|p| coordinates(p)[2] = f64::NAN, "State"),
        (|p| coordinates(p)[5] = 3.5, "NotCanonical"),
        (|p| coordinates(p)[2] = -0.0, "NotCanonical"),
        (
            |p| columns(p).payloads[1] = vec![0; 65_537].into(),
            "Payload",
        ),
    ];
    let cases = cases.map(|(change, kind)| (read_changed(|_| {}, change), kind));
    let beyond = (read_changed(|h| h.next_id = 6, |_| {}), "Id");
    for (error, kind) in cases.into_iter().chain([beyond]) {
        let text = error.to_string();
        let SnapshotError::Point { position, problem } = error else {
            panic!("{text}");
        };
        assert_eq!(position.part, 2, "{text}");
        assert!(text.contains(&format!("point {}", position.row)), "{text}");
        assert!(format!("{problem:?}").starts_with(kind), "{text}");
    }
    let largest = |p: &mut v1::SnapshotPoints| columns(p).payloads[1] = vec![0; 65_536].into();
    assert_error!(read_changed(|h| h.point_count = 4, largest), Count { .. });
    let next_id = PointProblem::Id { next_id: 6 };
    assert!(next_id.to_string().contains("next_id, which is 6"));
}

#[test]
fn columns_and_counts_that_do_not_fit_are_refused() {
    let same = |_: &mut Header| {};
    let errors = [
        read_changed(same, |p| p.points = None),
        read_changed(same, |p| columns(p).states = None),
        read_changed(same, |p| coordinates(p).truncate(5)),
        read_changed(same, |p| columns(p).states.as_mut().unwrap().row_count = 2),
        read_changed(same, |p| columns(p).tags.truncate(2)),
        read_changed(same, |p| columns(p).revisions.push(1)),
        read_changed(same, |p| columns(p).payloads.truncate(2)),
        read_changed(same, |p| {
            columns(p).payloads = vec![Default::default(); 100]
        }),
        read_changed(same, |p| p.modified_revisions.clear()),
        read_changed(|h| h.space = "R3".parse().unwrap(), |_| {}),
        read_changed(|h| h.point_count = 2, |_| {}),
        read_changed(|h| h.point_count = 4, |_| {}),
        read_changed(|h| h.next_id = (1 << 63) + 1, |_| {}),
    ];
    assert!(
        errors[7].to_string().contains("100 entries in "),
        "{}",
        errors[7]
    );
    for error in errors {
        assert_eq!(error.reason(), "SNAPSHOT_INVALID", "{error}");
        assert!(error.to_string().contains("part "), "{error}");
    }
}

#[test]
fn payloads_may_be_left_out() {
    let mut without = points(&[1, 2]);
    columns(&mut without).payloads.clear();
    let parts = three_parts(&header(2), without);
    assert_eq!(check(&file(&parts)[..]).unwrap(), header(2));
}

#[test]
fn a_length_beyond_any_part_is_not_believed() {
    for length in [
        &b"\xff\xff\xff\xff\x0f"[..],
        b"\xff\xff\xff\xff\xff\xff\xff\xff\xff\x7f",
    ] {
        let bytes = [b"wayfold snapshot 3\n", length].concat();
        assert_error!(check(&bytes[..]).unwrap_err(), TooLarge { part: 1, .. });
    }
    let endless = [b"wayfold snapshot 3\n", &[0xff; 11][..]].concat();
    assert_error!(check(&endless[..]).unwrap_err(), Malformed { .. });
}
