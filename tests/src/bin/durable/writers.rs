//! Inserts into an index in memory that request the neighbours of the inserted states, 64 at a time, without the network.
//! They show the parallelism of inserts although an index has only one writer.

use std::sync::Arc;

use wayfold_server::{log::MemoryLog, registry::RegistryOptions};
use wayfold_tests::{States, figures::median, report::Report};

use crate::{
    CLIENTS, INDEX, K, SPACE,
    rates::{self, Round},
    service::{LocalService, insertion},
};

/// The numbers of states in one call.
const BATCHES: [usize; 2] = [1, 100];
/// The number of initial points, and of inserted ones.
const POINTS: usize = 50_000;

pub(crate) async fn measure(rounds: usize, report: &mut Report) {
    report.section("64 writers, an index in memory, k = 10", "");
    for batch in BATCHES {
        let (mut rates, mut processors) = (Vec::new(), Vec::new());
        for round in 0..rounds {
            let written = write(batch, round as u64).await;
            rates.push(written.rate);
            processors.push(written.rate * written.processor_us.1 / 1e6);
        }
        report.note(&format!("states, {batch} a call"), median(rates), "/s");
        let busy = format!("  processors busy, {batch} a call");
        report.note(&busy, median(processors), "");
    }
}

async fn write(batch: usize, round: u64) -> Round {
    let service = LocalService::over(Arc::new(MemoryLog::new()), RegistryOptions::default());
    service.create(INDEX).await;
    let mut states = States::new(SPACE.parse().expect("a space"), 50 + round);
    for _ in 0..POINTS / 1_000 {
        service.insert(insertion(&states.rows(1_000), None)).await;
    }
    let each = POINTS / CLIENTS / batch * batch;
    let pools = (0..CLIENTS).map(|_| states.rows(each)).collect();
    rates::write(&service, pools, (each * CLIENTS, batch), Some(K)).await
}
