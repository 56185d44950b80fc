//! Answers short searches on Zenoh's thread that read the query: another thread for a search of microseconds, and a
//! third for its answer, would cost many times the search.
//!
//! These threads read all links and must not block. So only short searches with a small request and a small answer are
//! answered inline. A link may still refuse an answer for a while: Zenoh has two of these threads, only one of them
//! sends answers at a time, and the other continues.
//!
//! Under load, many queries are read from a link together. An answer to each before the next query is read would wake
//! Zenoh's other threads, which write and keep time, once for each. So queries that are read together are answered
//! together, when nothing more can be read.

use std::{collections::HashMap, sync::Arc, task::Poll, time::Duration};

use futures_util::future::BoxFuture;
use parking_lot::Mutex;
use tokio::{runtime::Handle, task};

use super::response::Response;
use crate::latency_gate::LatencyGate;

/// While recent searches take less time, they are answered inline.
const MAX_SEARCH_TIME: Duration = Duration::from_micros(50);

/// The largest payload of a query or an answer. A caller whose larger messages fill its link in both directions would
/// deadlock: it sends before it reads, and the answers wait for it to read.
pub(super) const MAX_BYTES: usize = 4096;

/// Most queries that are answered together: the first of them waits for the others.
const MAX_BATCH: usize = 16;

/// The future of a query's response.
pub(super) type ResponseFuture = BoxFuture<'static, Response>;

/// Answers queries inline where that is short, and elsewhere otherwise.
pub(super) struct Inline {
    /// Runs what is not answered inline.
    runtime: Handle,
    latency_gate: LatencyGate,
    /// Queries that wait until the task that reads their link has nothing more to read. Links are kept apart: the
    /// answers to one of them may block.
    waiting: Mutex<HashMap<task::Id, Vec<ResponseFuture>>>,
    sending: Mutex<()>,
}

impl Inline {
    pub(super) fn new(runtime: Handle) -> Self {
        Self {
            runtime,
            latency_gate: LatencyGate::new(MAX_SEARCH_TIME),
            waiting: Mutex::default(),
            sending: Mutex::default(),
        }
    }

    /// Answers a query that was just read from a link, inline if its search is short.
    pub(super) fn run(self: &Arc<Self>, answering: ResponseFuture) {
        // The running task is the one that reads the link.
        let Some(reader) = task::try_id() else {
            return self.run_elsewhere(answering);
        };
        let mut waiting = self.waiting.lock();
        let of_link = waiting.entry(reader).or_default();
        of_link.push(answering);
        match of_link.len() {
            1 => {
                let inline = Arc::clone(self);
                // Runs on this thread as soon as the task that reads the link waits for more.
                task::spawn(async move { inline.answer_waiting(reader) });
            }
            MAX_BATCH.. => {
                drop(waiting);
                self.answer_waiting(reader);
            }
            _ => {}
        }
    }

    fn answer_waiting(self: &Arc<Self>, reader: task::Id) {
        let waiting = self.waiting.lock().remove(&reader).unwrap_or_default();
        let mut all = Vec::with_capacity(waiting.len());
        // Timers that the queries start must belong to the server's runtime.
        let in_runtime = self.runtime.enter();
        for mut answering in waiting {
            match self.latency_gate.attempt(answering.as_mut()) {
                Poll::Ready(answered) if answered.bytes() <= MAX_BYTES => all.push(answered),
                Poll::Ready(answered) => self.send_elsewhere(vec![answered]),
                // The search waits, or has used its time slice.
                Poll::Pending => self.run_elsewhere(answering),
            }
        }
        drop(in_runtime);
        self.send(all);
    }

    /// Sends answers from this thread of Zenoh's, unless another of them is sending.
    pub(super) fn send(&self, all: Vec<Response>) {
        match self.sending.try_lock() {
            Some(_only_one) => send(all),
            None => self.send_elsewhere(all),
        }
    }

    /// Answers a query on another thread.
    pub(super) fn run_elsewhere(self: &Arc<Self>, answering: ResponseFuture) {
        let inline = Arc::clone(self);
        let answered = async move { inline.send_elsewhere(vec![answering.await]) };
        self.runtime.spawn(answered);
    }

    /// Sends answers from a thread that may wait for room on the caller's link.
    fn send_elsewhere(&self, all: Vec<Response>) {
        self.runtime.spawn_blocking(|| send(all));
    }
}

fn send(all: Vec<Response>) {
    all.into_iter().for_each(Response::send);
}
