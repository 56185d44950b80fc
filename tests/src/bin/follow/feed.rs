//! Inserts at a fixed rate.

use std::time::{Duration, Instant};

use tokio::{sync::mpsc, task::JoinSet, time::MissedTickBehavior};
use wayfold::{IndexHandle, Revision};
use wayfold_proto::v1::InsertRequest;
use wayfold_tests::{States, Stubs, row_states};

use crate::{WIDTH, phase::Setting};

/// An acknowledged insert.
pub(crate) struct Inserted {
    pub(crate) rows: Vec<f64>,
    pub(crate) revision: Revision,
    pub(crate) sent: Instant,
    pub(crate) acknowledged: Instant,
}

/// The cost of feeding.
pub(crate) struct FeedCost {
    /// Points inserted per second.
    pub(crate) rate: f64,
    /// The durations of calls to the echo meanwhile, one after the other.
    pub(crate) round_trips: Vec<Duration>,
}

/// Inserts batches, each at its time, and reports each insert. Meanwhile it calls the echo.
pub(crate) async fn feed(
    index: &IndexHandle,
    echo: &Stubs,
    setting: &Setting,
    seed: u64,
    reports: mpsc::UnboundedSender<Inserted>,
) -> FeedCost {
    let calls = setting.calls_per_second * setting.seconds;
    let mut states = States::new(index.space().clone(), 1_000 + seed);
    let batches: Vec<Vec<f64>> = (0..calls).map(|_| states.rows(setting.batch)).collect();
    let mut echo = echo.clone();
    let request = InsertRequest {
        states: Some(row_states(&states.rows(setting.batch), WIDTH)),
        ..Default::default()
    };
    let seconds = setting.seconds;
    let round_trips = tokio::spawn(async move {
        let mut taken = Vec::new();
        let mut times = tokio::time::interval(Duration::from_millis(5));
        for _ in 0..200 * seconds {
            times.tick().await;
            let called = Instant::now();
            echo.insert(request.clone()).await;
            taken.push(called.elapsed());
        }
        taken
    });
    let started = Instant::now();
    let mut times = tokio::time::interval(Duration::from_secs(1) / setting.calls_per_second as u32);
    times.set_missed_tick_behavior(MissedTickBehavior::Burst);
    let mut inserts = JoinSet::new();
    for rows in batches {
        times.tick().await;
        let (index, reports) = (index.clone(), reports.clone());
        inserts.spawn(async move {
            let sent = Instant::now();
            let inserted = index.insert(rows.chunks(WIDTH)).await.expect("an insert");
            // The receiver is gone if the inserts are not measured.
            let _ = reports.send(Inserted {
                rows,
                revision: inserted.revision,
                sent,
                acknowledged: Instant::now(),
            });
        });
    }
    inserts.join_all().await;
    let rate = (calls * setting.batch) as f64 / started.elapsed().as_secs_f64();
    FeedCost {
        rate,
        round_trips: round_trips.await.expect("the echo's caller"),
    }
}
