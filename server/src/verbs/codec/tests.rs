use std::fmt::Debug;

use proptest::{collection::vec, prelude::*};
use prost::Message;
use wayfold_proto::v1::{self, knn_request::KForm};

use super::*;
use crate::{service::Code, testing};

fn read<M: Name + Default>(json: &str) -> M {
    let read = Form::Json.read(json.as_bytes(), &[]);
    read.unwrap_or_else(|error| panic!("{json}: {error}"))
}

fn write(message: &impl Name) -> String {
    String::from_utf8(Form::Json.write(message).unwrap()).unwrap()
}

/// The field and the reason of a refusal.
fn refused<M: Name + Default + Debug>(
    json: &str,
    parameters: &[(&str, &str)],
) -> (String, &'static str) {
    let read = Form::Json.read::<M>(json.as_bytes(), parameters);
    let error = read.unwrap_err();
    assert_eq!(error.code(), Code::InvalidArgument, "{error}");
    let Error::InvalidArgument { violations } = error else {
        panic!("{error}");
    };
    (violations[0].field.clone(), violations[0].reason)
}

fn revision(uid: &str, number: u64) -> Option<v1::Revision> {
    let uid = uid.into();
    Some(v1::Revision { uid, number })
}

fn states(rows: u32, coordinates: &[f64]) -> Option<v1::States> {
    Some(v1::States {
        row_count: rows,
        coordinates: coordinates.into(),
    })
}

#[test]
fn states_are_rows_or_one_row_or_the_message() {
    let two = v1::KnnRequest {
        states: states(2, &[1.0, 2.0, 3.0, 4.5]),
        k_form: Some(KForm::K(10)),
        ..Default::default()
    };
    for json in [
        r#"{"states": [[1, 2], [3, 4.5]], "k": 10}"#,
        r#"{"states": {"row_count": 2, "coordinates": [1, 2, 3, 4.5]}, "k": 10}"#,
    ] {
        assert_eq!(read::<v1::KnnRequest>(json), two);
    }
    let one = v1::KnnRequest {
        states: states(1, &[1.0, 2.0]),
        ..Default::default()
    };
    for json in ["[1, 2]", "[[1, 2]]", r#"{"states": [1, 2]}"#] {
        assert_eq!(read::<v1::KnnRequest>(json), one);
    }
    for (json, rows) in [("[]", 0), ("[[]]", 1), ("[[], []]", 2)] {
        let request: v1::KnnRequest = read(json);
        assert_eq!(request.states, states(rows, &[]), "{json}");
    }
}

#[test]
fn numbers_that_json_lacks_are_written_as_text() {
    let request: v1::InsertRequest = read(
        r#"{"states": [["NaN", "-Infinity"]], "ids": [9007199254740991, "9223372036854775807"],
            "payloads": ["AP8=", ""], "on_conflict": "REPLACE",
            "neighbor_spec": {"radius": "Infinity", "filter": {"tag_mask": "18446744073709551615"}}}"#,
    );
    let coordinates = request.states.unwrap().coordinates;
    assert!(coordinates[0].is_nan() && coordinates[1] == f64::NEG_INFINITY);
    assert_eq!(request.ids, [(1 << 53) - 1, (1 << 63) - 1]);
    assert_eq!(request.payloads, [&[0, 255][..], &[]]);
    assert_eq!(request.on_conflict, 2);
    let spec = request.neighbor_spec.unwrap();
    assert_eq!(spec.k_form, None);
    let radius = v1::neighbor_spec::RadiusForm::Radius(f64::INFINITY);
    assert_eq!(spec.radius_form, Some(radius));
    assert_eq!(spec.filter.unwrap().tag_mask, u64::MAX);
    for (json, value) in [
        (r#""ON_CONFLICT_REPLACE""#, 2),
        (r#""FAIL""#, 1),
        ("0", 0),
        ("7", 7),
    ] {
        let json = format!(r#"{{"on_conflict": {json}}}"#);
        let request: v1::InsertRequest = read(&json);
        assert_eq!(request.on_conflict, value);
    }
}

#[test]
fn answers_are_rows_under_the_names_of_the_message() {
    let answer = v1::KnnResponse {
        neighbors: Some(v1::Neighbors {
            neighbor_counts: vec![2, 0, 1],
            ids: vec![3, 1 << 53, 4],
            distances: vec![0.1, f64::INFINITY, 0.0],
            states: states(3, &[1.0, -0.0, 0.3, 4.0, 5.0, 6.0]),
            payloads: vec![vec![0, 255].into(), vec![].into(), vec![].into()],
            ..Default::default()
        }),
        revision: revision("a\"b", 7),
    };
    assert_eq!(
        write(&answer),
        concat!(
            r#"{"ids":[[3,"9007199254740992"],[],[4]],"distances":[[0.1,"Infinity"],[],[0.0]],"#,
            r#""states":[[[1.0,-0.0],[0.3,4.0]],[],[[5.0,6.0]]],"payloads":[["AP8=",""],[],[""]],"#,
            r#""revision":{"uid":"a\"b","number":7}}"#,
        )
    );
    let answer = v1::InsertResponse {
        outcomes: vec![1, 4],
        ids: vec![5, 6],
        revision: revision("", 0),
        ..Default::default()
    };
    assert_eq!(
        write(&answer),
        r#"{"outcomes":["INSERTED","TOO_CLOSE"],"ids":[5,6],"revision":{"uid":"","number":0}}"#
    );
    let answer = v1::WatchResponse {
        mutations: vec![v1::Mutation {
            revision: revision("u", 2),
            stored: Some(v1::Points {
                ids: vec![1],
                states: states(1, &[0.5]),
                tags: vec![u64::MAX],
                revisions: vec![2],
                payloads: vec![],
            }),
            session: u64::MAX,
            batch: 4,
            ..Default::default()
        }],
        reset: Some(2),
        revision: revision("u", 3),
    };
    assert_eq!(
        write(&answer),
        concat!(
            r#"{"revision":{"uid":"u","number":3},"mutations":[{"revision":{"uid":"u","number":2},"time_ms":0,"stored":{"ids":[1],"states":[[0.5]],"#,
            r#""tags":["18446744073709551615"],"revisions":[2]},"removed_ids":[],"continued":false,"piece":0,"#,
            r#""session":"18446744073709551615","batch":4}],"#,
            r#""reset":"WINDOW_PASSED"}"#,
        )
    );
}

#[test]
fn an_error_names_the_wrong_part() {
    for (json, field, reason) in [
        ("{", "request", "MALFORMED_MESSAGE"),
        ("7", "request", "TYPE"),
        (r#"{"states": [[1, 2], [3]]}"#, "states[1]", "WIDTH"),
        (r#"{"states": [[1, 2], 3]}"#, "states[1]", "TYPE"),
        (r#"{"states": [[1, "2"]]}"#, "states[0].coords[1]", "TYPE"),
        (r#"{"k": -1}"#, "k", "TYPE"),
        (r#"{"k": 4294967296}"#, "k", "TYPE"),
        (r#"{"k": 1.5}"#, "k", "TYPE"),
        (r#"{"K": 1}"#, "K", "UNKNOWN_FIELD"),
        (r#"{"filter": {"mask": 1}}"#, "filter.mask", "UNKNOWN_FIELD"),
        (r#"{"filter": 3}"#, "filter", "TYPE"),
        (
            r#"{"include": {"with_tags": 1}}"#,
            "include.with_tags",
            "TYPE",
        ),
        (r#"{"k": 1, "k_factor": 2}"#, "k_factor", "AMBIGUOUS"),
        (
            r#"{"k": 1, "max_leaves": 2}"#,
            "max_leaves",
            "UNKNOWN_FIELD",
        ),
    ] {
        let found = refused::<v1::KnnRequest>(json, &[]);
        assert_eq!((&*found.0, found.1), (field, reason), "{json}");
    }
    let inserted = |json| refused::<v1::InsertRequest>(json, &[]);
    let got = |json| refused::<v1::GetRequest>(json, &[]);
    let created = |json| refused::<v1::CreateIndexRequest>(json, &[]);
    let spaces = r#"{"space": {"so2": {}, "so3": {}}}"#;
    let forms = r#"{"space": {"so3": {}}, "space_text": "SO3"}"#;
    for (found, field, reason) in [
        (
            inserted(r#"{"on_conflict": "KEEP"}"#),
            "on_conflict",
            "UNKNOWN_VALUE",
        ),
        (inserted(r#"{"payloads": ["?"]}"#), "payloads[0]", "TYPE"),
        (got(r#"{"ids": [1, "x"]}"#), "ids[1]", "TYPE"),
        (got("[1]"), "request", "TYPE"),
        (created(spaces), "space.so3", "AMBIGUOUS"),
        (created(forms), "space_text", "AMBIGUOUS"),
    ] {
        assert_eq!((&*found.0, found.1), (field, reason));
    }
}

#[test]
fn parameters_say_what_the_message_does_not() {
    let parameters = [
        ("k", "10"),
        ("r", "0.5"),
        ("eps", "0"),
        ("include", "tags,payloads"),
    ];
    let expected = v1::KnnRequest {
        states: states(1, &[1.0]),
        k_form: Some(KForm::K(10)),
        radius_form: Some(v1::knn_request::RadiusForm::Radius(0.5)),
        include: Some(v1::Include {
            with_tags: true,
            with_payloads: true,
            ..Default::default()
        }),
        ..Default::default()
    };
    let protobuf = v1::KnnRequest {
        states: states(1, &[1.0]),
        ..Default::default()
    }
    .encode_to_vec();
    for (form, payload) in [(Form::Json, &b"[1]"[..]), (Form::Protobuf, &protobuf)] {
        let request: v1::KnnRequest = form.read(payload, &parameters).unwrap();
        assert_eq!(request, expected);
        let again = form.write(&expected).unwrap();
        let repeated: v1::KnnRequest = form.read(&again, &parameters).unwrap();
        assert_eq!(repeated, expected);
    }
    let get: v1::GetRequest = Form::Json
        .read(
            b"",
            &[("ids", "3,9223372036854775807"), ("include", "payloads")],
        )
        .unwrap();
    assert_eq!(get.ids, [3, (1 << 63) - 1]);
    assert!(get.include.unwrap().with_payloads);
    let followed = [("from", "7"), ("uid", "u")];
    let watch =
        |json: &str, parameters| Form::Json.read::<v1::WatchRequest>(json.as_bytes(), parameters);
    for json in ["", r#"{"after_revision":{"uid":"u"}}"#] {
        let read = watch(json, &followed).unwrap();
        assert_eq!(read.after_revision, revision("u", 7));
    }
    for json in [
        r#"{"after_revision":{"uid":"v"}}"#,
        r#"{"after_revision":{"uid":"u","number":0}}"#,
    ] {
        assert!(watch(json, &followed).is_err(), "{json}");
    }
    let deletion: v1::DeleteIndexRequest = Form::Json
        .read(b"{}", &[("index_name", "arm"), ("uid", "u")])
        .unwrap();
    assert_eq!((&*deletion.index_name, &*deletion.uid), ("arm", "u"));
    for (parameters, field, reason) in [
        (&[("k", "5")][..], "k", "CONFLICT"),
        (&[("r", "1"), ("radius", "2")], "radius", "CONFLICT"),
        (
            &[("include", "tags"), ("include", "states")],
            "include",
            "CONFLICT",
        ),
        (&[("eps", "0.5")], "epsilon", "CONFLICT"),
        (&[("include", "tag")], "include", "UNKNOWN_VALUE"),
        (&[("k_factor", "2")], "k_factor", "AMBIGUOUS"),
        (&[("from", "2")], "from", "UNKNOWN_PARAMETER"),
        (&[("timeout_ms", "5")], "timeout_ms", "UNKNOWN_PARAMETER"),
        (&[("r", "far")], "radius", "TYPE"),
        (&[("k", "-1")], "k", "TYPE"),
        (&[("kk", "1")], "kk", "UNKNOWN_PARAMETER"),
        (&[("index_name", "arm")], "index_name", "UNKNOWN_PARAMETER"),
        (&[("filter", "1")], "filter", "UNKNOWN_PARAMETER"),
    ] {
        let found = refused::<v1::KnnRequest>(r#"{"k": 10, "epsilon": 0}"#, parameters);
        assert_eq!((&*found.0, found.1), (field, reason), "{parameters:?}");
    }
}

#[test]
fn details_of_errors_are_written_out() {
    let error = invalid("k", "TOO_SMALL", "0");
    let status = crate::status::from_error(&error).to_message();
    let json: serde_json::Value = serde_json::from_str(&write(&status)).unwrap();
    assert_eq!(json["code"], 3);
    assert_eq!(json["details"][0]["reason"], "TOO_SMALL");
    let field = &json["details"][1];
    assert_eq!(field["@type"], "type.googleapis.com/google.rpc.BadRequest");
    assert_eq!(field["field_violations"][0]["field"], "k");
}

proptest! {
    #![proptest_config(testing::cases(200))]

    #[test]
    fn no_bit_is_lost(
        coordinates in vec(any::<f64>().prop_filter("a bit pattern of its own", |c| !c.is_nan()), 0..20),
        ids in vec(any::<u64>(), 0..20),
        payload in vec(any::<u8>(), 0..20),
        k in any::<u32>(),
    ) {
        let request = v1::InsertRequest {
            index_name: "ä\n\u{0}".into(),
            states: states(coordinates.len() as u32, &coordinates),
            ids,
            payloads: vec![payload.into()],
            neighbor_spec: Some(v1::NeighborSpec {
                k_form: Some(v1::neighbor_spec::KForm::K(k)),
                ..Default::default()
            }),
            ..Default::default()
        };
        let json = Form::Json.write(&request).unwrap();
        let back: v1::InsertRequest = Form::Json.read(&json, &[]).unwrap();
        prop_assert_eq!(back.encode_to_vec(), request.encode_to_vec());
    }

    #[test]
    fn no_text_brings_it_down(text in vec(any::<u8>(), 0..60)) {
        for form in [Form::Json, Form::Protobuf] {
            let _ = form.read::<v1::InsertRequest>(&text, &[]);
        }
    }
}
