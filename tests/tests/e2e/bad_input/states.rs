//! Bad states, whichever call carries them.

use tonic::Code::{self, InvalidArgument};
use wayfold_proto::v1::{
    InsertRequest, KnnRequest, QueryRequest, States, knn_request::Count, query_request::Reach,
};
use wayfold_tests::row_states;

use super::{Bench, INDEX, good_row};

type Expected = (Code, &'static str, &'static str);

/// All faults that a state can have, whichever call carries it.
fn bad_states() -> Vec<(&'static str, Option<States>, Expected)> {
    let row = |at: usize, value: f64| {
        let mut row = good_row();
        row[at] = value;
        Some(row_states(&row, 7))
    };
    let second_row = [good_row(), vec![0.0, f64::NAN, 0.0, 0.0, 0.0, 0.0, 1.0]].concat();
    let bad = |reason, field| (InvalidArgument, reason, field);
    vec![
        ("no states", None, bad("REQUIRED", "states")),
        ("NaN", row(2, f64::NAN), bad("NAN", "states[0].coords[2]")),
        (
            "NaN in the second row",
            Some(row_states(&second_row, 7)),
            bad("NAN", "states[1].coords[1]"),
        ),
        (
            "infinity",
            row(0, f64::NEG_INFINITY),
            bad("INFINITE", "states[0].coords[0]"),
        ),
        (
            "an infinite quaternion",
            row(6, f64::INFINITY),
            bad("INFINITE", "states[0].coords[6]"),
        ),
        (
            "a square that overflows",
            row(1, 1e151),
            bad("TOO_LARGE", "states[0].coords[1]"),
        ),
        (
            "a norm off by more than 1 %",
            row(6, 1.02),
            bad("NORM", "states[0].coords[3]"),
        ),
        (
            "a quaternion of zeros",
            row(6, 0.0),
            bad("NORM", "states[0].coords[3]"),
        ),
        (
            "a coordinate too few",
            Some(row_states(&good_row()[..6], 6)),
            bad("WIDTH", "states.coordinates"),
        ),
        (
            "a row more than there is",
            Some(States {
                rows: 2,
                coordinates: good_row(),
            }),
            bad("WIDTH", "states.coordinates"),
        ),
    ]
}

#[tokio::test]
async fn bad_states_are_refused_by_every_call_that_takes_states() {
    let bench = Bench::new().await;
    let mut stub = bench.stubs.points.clone();
    for (what, states, expected) in bad_states() {
        let insert = InsertRequest {
            index: INDEX.into(),
            states: states.clone(),
            ..Default::default()
        };
        let answer = stub.insert(insert).await;
        bench.refused(what, answer, expected).await;
        let knn = KnnRequest {
            index: INDEX.into(),
            states: states.clone(),
            count: Some(Count::K(1)),
            ..Default::default()
        };
        let answer = stub.knn(knn).await;
        bench.refused(what, answer, expected).await;
        let query = QueryRequest {
            index: INDEX.into(),
            states,
            reach: Some(Reach::Radius(1.0)),
            ..Default::default()
        };
        let answer = stub.query(query).await;
        bench.refused(what, answer, expected).await;
    }
}
