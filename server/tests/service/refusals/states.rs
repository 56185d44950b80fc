//! States that every call refuses.

use wayfold_proto::v1;

use super::assert_invalid;
use crate::support::*;

pub(super) const GOOD: [f64; 7] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];

/// All faults that states can have.
fn bad_states() -> Vec<(Option<v1::States>, &'static str, &'static str)> {
    let with = |at: usize, value: f64| {
        let mut bad = GOOD;
        bad[at] = value;
        states(&[GOOD, bad])
    };
    let missing_coordinate = v1::States {
        row_count: 2,
        coordinates: [&GOOD[..], &GOOD[..6]].concat(),
    };
    let missing_row = v1::States {
        row_count: 3,
        coordinates: [GOOD, GOOD].concat(),
    };
    vec![
        (None, "REQUIRED", "states"),
        (with(1, f64::NAN), "NAN", "states[1].coords[1]"),
        (with(0, f64::INFINITY), "INFINITE", "states[1].coords[0]"),
        (
            with(0, f64::NEG_INFINITY),
            "INFINITE",
            "states[1].coords[0]",
        ),
        (with(6, f64::INFINITY), "INFINITE", "states[1].coords[6]"),
        (with(2, 1e151), "TOO_LARGE", "states[1].coords[2]"),
        // The norm is off by more than 1 %.
        (with(6, 1.02), "NORM", "states[1].coords[3]"),
        (with(6, 0.0), "NORM", "states[1].coords[3]"),
        (Some(missing_coordinate), "WIDTH", "states.coordinates"),
        (Some(missing_row), "WIDTH", "states.coordinates"),
    ]
}

#[tokio::test]
async fn bad_states_are_refused_by_every_call_that_takes_states() {
    let (service, _) = arm("R3*SO3:0.15").await;
    insert_rows(&service, &[GOOD], &[]).await;
    let before = everything(&service).await;
    for (states, reason, field) in bad_states() {
        let insert = v1::InsertRequest {
            states: states.clone(),
            ..insertion(&[GOOD], &[])
        };
        assert_invalid(service.insert(&CALL, insert).await, reason, field);
        let search = v1::KnnRequest {
            states: states.clone(),
            ..knn(&[GOOD], 1)
        };
        assert_invalid(service.knn(&CALL, search).await, reason, field);
        let query = v1::QueryRequest {
            index_name: "arm".into(),
            states,
            radius_form: within(1.0),
            ..Default::default()
        };
        assert_invalid(service.query(&CALL, query).await, reason, field);
    }
    assert_eq!(everything(&service).await, before);
}
