//! Number and radius scaled by the size of the index, in cases that the random comparison with a model does not reach.

use std::collections::HashSet;

use futures_util::future::join_all;
use wayfold_index::{Linear, PointRef, Search, Space};
use wayfold_proto::v1::{
    self,
    neighbor_spec::{KForm, RadiusForm},
};
use wayfold_server::service::{Code, Error, Limits};

use crate::{cancellation::poll_into_evaluation, support::*};

fn by(k_factor: f64) -> Option<KForm> {
    Some(KForm::KFactor(k_factor))
}

fn scaled(factor: f64, max: Option<f64>) -> Option<RadiusForm> {
    Some(RadiusForm::ScaledRadius(v1::ScaledRadius { factor, max }))
}

/// Inserts that searched before a long insert and are applied after it are evaluated by the size of the index at their
/// turn.
#[tokio::test]
async fn an_insert_counts_the_points_at_its_turn_and_not_when_it_searched_ahead() {
    let (service, _) = arm("R3").await;
    let first = insertion(&cube(1, 1000), &[]);
    service.insert(&CALL, first).await.unwrap();
    // The long insert is far away, so the neighbours stay the same, and k(n) asks for more of them.
    let far = cube(2, 10_000).into_iter().map(|[x, y, z]| [x + 5.0, y, z]);
    let long = v1::InsertRequest {
        min_separation: 1e-9,
        ..insertion(&far.collect::<Vec<_>>(), &[])
    };
    let mut long = Box::pin(service.insert(&CALL, long));
    let waiting = poll_into_evaluation(&service, &mut long).await;
    let scalings = [
        (by(4.0), None),
        (None, scaled(1.4, Some(0.7))),
        (by(30.0), scaled(1.2, None)),
    ];
    let rows = cube(5, 30);
    let calls = rows.iter().zip(scalings.iter().cycle());
    let calls = calls.map(async |(row, forms)| {
        let request = v1::InsertRequest {
            neighbor_spec: Some(v1::NeighborSpec {
                k_form: forms.0,
                radius_form: forms.1,
                ..Default::default()
            }),
            ..insertion(&[*row], &[])
        };
        (row, forms, service.insert(&CALL, request).await.unwrap())
    });
    // All calls are polled at once, so that none waits for a call that is not polled.
    let (long, waiting, responses) = tokio::join!(long, waiting, join_all(calls));
    long.unwrap();
    waiting.unwrap();

    let mut points = Vec::new();
    let mut scan = service.scan(&CALL, scanning()).await.unwrap();
    while let Some(part) = scan.next().await {
        let part = part.unwrap().points.unwrap();
        let rows = part.states.unwrap().coordinates;
        let ids = part.ids.into_iter().zip(part.revisions);
        let rows = rows.chunks_exact(3).map(<[f64]>::to_vec);
        points.extend(ids.zip(rows));
    }
    for (row, forms, response) in responses {
        let mut before = Linear::new("R3".parse().unwrap());
        for ((id, revision), row) in &points {
            if *revision < response.revision.number() {
                before
                    .insert(PointRef {
                        id: *id,
                        tag: 0,
                        revision: *revision,
                        row,
                    })
                    .unwrap();
            }
        }
        let n = before.len() as f64;
        let mut search = Search::nearest_k(usize::MAX);
        if let Some(KForm::KFactor(factor)) = forms.0 {
            search.k = (factor * n.ln()).ceil() as usize;
        }
        if let Some(RadiusForm::ScaledRadius(scaled)) = forms.1 {
            let radius = scaled.factor * (n.ln() / n).powf(1.0 / 3.0);
            search.radius = radius.min(scaled.max.unwrap_or(f64::INFINITY));
        }
        let expected = before.search(row, &search).unwrap().neighbors;
        let expected: Vec<u64> = expected.iter().map(|neighbor| neighbor.id).collect();
        assert!(!expected.is_empty());
        let found = response.neighbors.unwrap().ids;
        assert_eq!(found, expected, "{n} points, {forms:?}");
    }
}

/// Skipped rows and rows that replace a point do not raise n. A row whose id is stored counts that point, although it
/// does not find it.
#[tokio::test]
async fn rows_count_the_rows_before_them_that_are_new() {
    let (service, _) = arm("R1").await;
    let first = insertion(&[[0.0], [1.0], [2.0], [3.0]], &[0, 1, 2, 3]);
    service.insert(&CALL, first).await.unwrap();
    // k(n) = ceil(3 ln n): 5 for 4 and 5, 6 for 6 and 7.
    let request = v1::InsertRequest {
        on_conflict: v1::OnConflict::Replace.into(),
        min_separation: 0.5,
        neighbor_spec: Some(v1::NeighborSpec {
            k_form: by(3.0),
            ..Default::default()
        }),
        ..insertion(
            &[[3.25], [10.0], [10.25], [11.0], [20.0], [21.0]],
            &[3, 4, 5, 6, 7, 8],
        )
    };
    let answer = service.insert(&CALL, request).await.unwrap();
    use v1::Outcome::{Inserted, Replaced, TooClose};
    let outcomes: Vec<v1::Outcome> = answer.outcomes().collect();
    assert_eq!(
        outcomes,
        [Replaced, Inserted, TooClose, Inserted, Inserted, Inserted]
    );
    // There are 4 points, one of them the row's own; then 4, 5, 5, 6 and 7.
    assert_eq!(
        answer.neighbors.unwrap().neighbor_counts,
        [3, 4, 5, 5, 6, 6]
    );
}

#[tokio::test]
async fn a_filter_does_not_change_how_many_points_there_are() {
    let (service, uid) = arm("R1").await;
    let rows: Vec<[f64; 1]> = (0..100).map(|x| [f64::from(x)]).collect();
    let request = v1::InsertRequest {
        tags: (0..100).map(|at| at % 2).collect(),
        ..insertion(&rows, &[])
    };
    service.insert(&CALL, request).await.unwrap();
    insert_rows(&service, &[[100.0], [101.0], [102.0]], &[]).await;
    for (filter, expected) in [
        // ceil(2 ln 103) = 10
        (v1::Filter::default(), (0..10).collect::<Vec<u64>>()),
        (
            v1::Filter {
                tag_mask: 1,
                tag_value: 1,
                ..Default::default()
            },
            (0..10).map(|at| 2 * at + 1).collect(),
        ),
        (
            v1::Filter {
                since_revision: revision(&uid, 1),
                ..Default::default()
            },
            vec![100, 101, 102],
        ),
    ] {
        let request = v1::KnnRequest {
            filter: Some(filter.clone()),
            k_form: by(2.0).map(Into::into),
            ..knn(&[[0.0]], 0)
        };
        let answer = service.knn(&CALL, request).await.unwrap();
        assert_eq!(answer.neighbors.unwrap().ids, expected, "{filter:?}");
    }
}

/// SE(3) has seven coordinates and the dimension 6.
#[tokio::test]
async fn the_dimension_is_the_manifolds() {
    let (service, _) = arm("R3*SO3:0.15").await;
    let space: Space = "R3*SO3:0.15".parse().unwrap();
    let rows: Vec<[f64; 7]> = cube(8, 400)
        .iter()
        .map(|[x, y, z]| [*x, *y, *z, 0.0, 0.0, 0.0, 1.0])
        .collect();
    service.insert(&CALL, insertion(&rows, &[])).await.unwrap();
    let radius = 0.5 * (400.0_f64.ln() / 400.0).powf(1.0 / 6.0);
    let query = v1::QueryRequest {
        index_name: "arm".into(),
        states: states(&rows[..20]),
        radius_form: scaled(0.5, None).map(Into::into),
        ..Default::default()
    };
    let answer = service.query(&CALL, query).await.unwrap();
    let counts = rows[..20].iter().map(|row| {
        let within = rows
            .iter()
            .filter(|other| space.distance(row, *other) <= radius);
        within.count() as u32
    });
    let counts: Vec<u32> = counts.collect();
    assert!(counts.iter().collect::<HashSet<_>>().len() > 1);
    assert_eq!(answer.neighbors.unwrap().neighbor_counts, counts);
}

#[tokio::test]
async fn the_limits_of_k_and_of_an_answer_hold_for_scaled_searches() {
    let limits = Limits {
        max_k: 40,
        max_answer_bytes: 2000,
        ..Limits::default()
    };
    let log = std::sync::Arc::new(wayfold_server::log::MemoryLog::new());
    let service = service_with(log, limits);
    create(&service, "arm", "R3").await;
    let exceeded = |error: Error| match error {
        Error::LimitExceeded {
            limit,
            value,
            requested,
            ..
        } => (limit, value, requested),
        other => panic!("{other}"),
    };
    for start in [0, 50] {
        let ids: Vec<u64> = (start..start + 50).collect();
        insert_rows(&service, &cube(start, 50), &ids).await;
    }
    let ask = |k_factor, rows: usize| v1::KnnRequest {
        k_form: by(k_factor).map(Into::into),
        ..knn(&cube(7, rows), 0)
    };
    // ln 100 = 4.6052: 8.6 of it are 39.6, and 9 are 41.4.
    let answer = service.knn(&CALL, ask(8.6, 1)).await.unwrap();
    assert_eq!(answer.neighbors.unwrap().neighbor_counts, [40]);
    let error = service.knn(&CALL, ask(9.0, 1)).await.unwrap_err();
    assert_eq!(exceeded(error), ("max_k", 40, 42));
    let error = service.knn(&CALL, ask(f64::MAX, 1)).await.unwrap_err();
    assert_eq!(exceeded(error), ("max_k", 40, usize::MAX as u64));
    let error = service.knn(&CALL, ask(8.6, 3)).await.unwrap_err();
    assert_eq!(error.code(), Code::ResourceExhausted);
    assert_eq!(exceeded(error).0, "max_answer_bytes");

    // An insert is refused before anything is stored, at whichever row: ceil(8.65 ln n) is 40 for 100 and 101, and 41
    // for 102.
    let insert = |k_factor, rows: usize| v1::InsertRequest {
        neighbor_spec: Some(v1::NeighborSpec {
            k_form: by(k_factor),
            ..Default::default()
        }),
        ..insertion(&cube(9, rows), &[])
    };
    let error = service.insert(&CALL, insert(8.65, 4)).await.unwrap_err();
    assert_eq!(exceeded(error), ("max_k", 40, 41));
    let error = service.insert(&CALL, insert(8.0, 4)).await.unwrap_err();
    assert_eq!(exceeded(error).0, "max_answer_bytes");
    let after = info(&service, "arm").await;
    assert_eq!((after.revision.number(), after.point_count), (2, 100));
}

const NAN: f64 = f64::NAN;
const INFINITE: f64 = f64::INFINITY;

#[tokio::test]
async fn invalid_scalings_are_named() {
    let (service, _) = arm("R3").await;
    insert_rows(&service, &[[0.0; 3]], &[]).await;
    let invalid = |reason, field: String| (Code::InvalidArgument, reason, field);
    let (factor, max) = ("scaled_radius.factor", "scaled_radius.max");
    for (count, radius_form, reason, field) in [
        (by(-1.0), None, "NEGATIVE", "k_factor"),
        (by(INFINITE), None, "INFINITE", "k_factor"),
        (by(NAN), None, "NAN", "k_factor"),
        (nearest(1), scaled(-1.0, None), "NEGATIVE", factor),
        (None, scaled(INFINITE, None), "INFINITE", factor),
        (by(2.0), scaled(NAN, None), "NAN", factor),
        (None, scaled(2.0, Some(-1.0)), "NEGATIVE", max),
        (None, scaled(2.0, Some(NAN)), "NAN", max),
    ] {
        let neighbor_spec = Some(v1::NeighborSpec {
            k_form: count,
            radius_form,
            ..Default::default()
        });
        let request = v1::InsertRequest {
            neighbor_spec,
            ..insertion(&[[0.0; 3]], &[])
        };
        let refused = refusal(service.insert(&CALL, request).await);
        let expected = invalid(reason, format!("neighbor_spec.{field}"));
        assert_eq!(refused, expected, "{count:?} {radius_form:?}");

        // `Knn` needs a number too.
        let request = v1::KnnRequest {
            k_form: count.or(nearest(1)).map(Into::into),
            radius_form: radius_form.map(Into::into),
            ..knn(&[[0.0; 3]], 1)
        };
        let refused = refusal(service.knn(&CALL, request.clone()).await);
        assert_eq!(refused, invalid(reason, field.into()), "{request:?}");
        if count.is_none() {
            for (count, reason) in [(None, "REQUIRED"), (nearest(0), "ZERO")] {
                let count = count.map(Into::into);
                let none = v1::KnnRequest {
                    k_form: count,
                    ..request.clone()
                };
                let refused = refusal(service.knn(&CALL, none).await);
                assert_eq!(refused, invalid(reason, "k".into()));
            }
        }

        if radius_form.is_some() {
            let query = v1::QueryRequest {
                index_name: "arm".into(),
                states: states(&[[0.0; 3]]),
                radius_form: radius_form.map(Into::into),
                ..Default::default()
            };
            let refused = refusal(service.query(&CALL, query).await);
            assert_eq!(refused, invalid(reason, field.into()), "{radius_form:?}");
        }
    }
    assert_eq!(info(&service, "arm").await.point_count, 1);
}
