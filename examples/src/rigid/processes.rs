//! The role of a worker process.

use super::{options::Job, scene::Rooms, worker::Worker};
use crate::planning::{error::PlanningError, processes::Reporter};

/// The role of a worker.
pub async fn work(job: &Job) -> Result<(), PlanningError> {
    let scene = Rooms::new();
    let at = (&job.server[..], &job.index[..]);
    let worker = Worker::open(&scene, at, job.source, job.number, job.seed).await?;
    let worker = worker.max_pending(job.max_pending);
    let mut worker = worker.min_separation(job.min_separation);

    let mut reporter = Reporter::ready(job, job.progress_ms, job.halt_at)?;
    let extended = worker.extend(job.milestones, |account| reporter.progress(account));
    extended.await?;
    reporter.done(&worker.account())
}
