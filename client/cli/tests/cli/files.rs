//! The files that states are read from.

use std::{fs, path::PathBuf};

use serde_json::json;

use crate::{process::Run, server::Server};

/// A server with an index over SE(2), and a directory for files.
struct Files {
    server: Server,
    directory: tempfile::TempDir,
}

impl Files {
    fn new() -> Files {
        let server = Server::start();
        server.json(&["create", "car", "--space", "R2*SO2"]).line();
        Files {
            server,
            directory: tempfile::tempdir().unwrap(),
        }
    }

    fn insert(&self, name: &str, bytes: impl AsRef<[u8]>) -> Run {
        let path: PathBuf = self.directory.path().join(name);
        fs::write(&path, bytes).unwrap();
        self.server.json(&["insert", "car", path.to_str().unwrap()])
    }

    /// The stored states, by id.
    fn states(&self) -> Vec<serde_json::Value> {
        let points = self.server.json(&["scan", "car"]).lines();
        points.iter().map(|point| point["state"].clone()).collect()
    }
}

/// The bytes of an npy file as NumPy's format description lays them out: magic, version 1.0, the header's length, the
/// header padded to 64 bytes and ended by a newline, the numbers.
pub(crate) fn npy(kind: &str, fortran: bool, shape: &str, numbers: &[u8]) -> Vec<u8> {
    let order = if fortran { "True" } else { "False" };
    let mut header = format!("{{'descr': '{kind}', 'fortran_order': {order}, 'shape': {shape}, }}");
    while !(10 + header.len() + 1).is_multiple_of(64) {
        header.push(' ');
    }
    header.push('\n');
    let length = u16::try_from(header.len()).unwrap().to_le_bytes();
    [
        b"\x93NUMPY\x01\x00",
        &length[..],
        header.as_bytes(),
        numbers,
    ]
    .concat()
}

pub(crate) fn f64s(numbers: &[f64]) -> Vec<u8> {
    numbers
        .iter()
        .flat_map(|number| number.to_le_bytes())
        .collect()
}

#[test]
fn csv_may_have_a_header_spaces_empty_lines_and_a_byte_order_mark() {
    let files = Files::new();
    let text = "\u{feff}x,y,theta\r\n0.5, 1.5 ,-0.25\r\n\r\n1e-3,+2,3.\r\n";
    assert_eq!(files.insert("a.txt", text).line()["inserted_count"], 2);
    assert_eq!(
        files.states(),
        [json!([0.5, 1.5, -0.25]), json!([0.001, 2.0, 3.0])]
    );
}

#[test]
fn a_file_without_rows_inserts_nothing() {
    let files = Files::new();
    for (name, bytes) in [
        ("a.csv", Vec::new()),
        ("b.csv", b"x,y,theta\n".to_vec()),
        ("c.npy", npy("<f8", false, "(0, 3)", &[])),
    ] {
        let done = files.insert(name, bytes).line();
        assert_eq!(
            (
                &done["inserted_count"],
                &done["first_id"],
                &done["revision"]["number"]
            ),
            (&json!(0), &json!(null), &json!(0))
        );
    }
}

#[test]
fn npy_of_doubles_is_read_by_row_or_by_column() {
    let files = Files::new();
    let by_row = f64s(&[0.1, 0.2, 0.3, 1.1, 1.2, 1.3]);
    let by_column = f64s(&[0.1, 1.1, 0.2, 1.2, 0.3, 1.3]);
    let big_endian: Vec<u8> = [2.5_f64, 2.25, 2.0]
        .iter()
        .flat_map(|number| number.to_be_bytes())
        .collect();
    assert_eq!(
        files
            .insert("rows.npy", npy("<f8", false, "(2, 3)", &by_row))
            .line()["inserted_count"],
        2
    );
    assert_eq!(
        files
            .insert("columns.NPY", npy("<f8", true, "(2, 3)", &by_column))
            .line()["inserted_count"],
        2
    );
    assert_eq!(
        files
            .insert("big.npy", npy(">f8", false, "(1, 3)", &big_endian))
            .line()["inserted_count"],
        1
    );
    let (first, second) = (json!([0.1, 0.2, 0.3]), json!([1.1, 1.2, 1.3]));
    assert_eq!(
        files.states(),
        [
            first.clone(),
            second.clone(),
            first,
            second,
            json!([2.5, 2.25, 2.0])
        ]
    );
}

#[test]
fn npy_of_one_dimension_is_one_state_and_floats_are_widened() {
    let files = Files::new();
    let floats: Vec<u8> = [0.1_f32, 0.5, -1.0]
        .iter()
        .flat_map(|number| number.to_le_bytes())
        .collect();
    assert_eq!(
        files
            .insert("a.npy", npy("<f4", false, "(3,)", &floats))
            .line()["inserted_count"],
        1
    );
    assert_eq!(files.states(), [json!([f64::from(0.1_f32), 0.5, -1.0])]);
}

#[test]
fn a_wrong_npy_says_what_is_wrong_with_it() {
    let files = Files::new();
    let cases = [
        (
            npy("<f8", false, "(2, 4)", &f64s(&[0.0; 8])),
            "a.npy: 4 numbers, where a state of R2*SO2 has 3",
        ),
        (
            npy("<i8", false, "(1, 3)", &[0; 24]),
            "a.npy: numbers of type '<i8', where float64 or float32",
        ),
        (
            npy("<f8", false, "(1, 1, 3)", &f64s(&[0.0; 3])),
            "a.npy: an array of shape [1, 1, 3]",
        ),
        (
            npy("<f8", false, "(2, 3)", &f64s(&[0.0; 5])),
            "a.npy[1, 2] (theta): ",
        ),
        (npy("<f8", true, "(2, 3)", &f64s(&[0.0; 5])), "a.npy: "),
        (
            npy(
                "<f8",
                false,
                "(2, 3)",
                &f64s(&[0.0, 0.0, 0.0, 0.0, f64::NAN, 0.0]),
            ),
            "a.npy[1, 1] (y): NaN",
        ),
        (b"x,y,theta\n".to_vec(), "a.npy: "),
    ];
    for (bytes, expected) in cases {
        let run = files.insert("a.npy", bytes);
        assert!(
            run.error(3).contains(expected),
            "{} has no {expected:?}",
            run.stderr
        );
    }
    assert!(files.states().is_empty());
}
