//! The role of a worker process.

use wayfold::{Client, RetryPolicy};

use super::{
    nearby::Source,
    options::{Job, Source as Form},
    scene::Rooms,
    worker::Worker,
};
use crate::planning::{error::PlanningError, processes::Reporter};

/// The role of a worker.
pub async fn work(job: &Job) -> Result<(), PlanningError> {
    // The worker waits for a server that is being restarted.
    let client = Client::builder().retry(RetryPolicy::until_deadline());
    let client = client.connect(&job.server).await?;
    let index = client.index(&job.index).await?;
    let source = match job.source {
        Form::Shared => Source::Replica(client.replica(&job.index).await?),
        _ => Source::Server,
    };
    let scene = Rooms::new();
    let worker = Worker::new(&scene, index, source, job.number, job.seed);
    let worker = worker.batch(job.batch);
    let mut worker = worker.min_separation(job.min_separation);

    let mut reporter = Reporter::ready(job, job.progress_ms, job.halt_at)?;
    let extended = worker.extend(job.milestones, |account| reporter.progress(account));
    extended.await?;
    reporter.done(&worker.account())
}
