//! What is answered on the thread that it arrives on, one of Zenoh's: to hand a search that takes microseconds to another
//! thread, and its answer to yet another, costs many times as much.
//!
//! These threads read all links, and must not be kept. So it is done only where nothing is waited for: a search that is
//! brief, of a small query, whose answer is small, too. That a link takes the answer cannot be known beforehand: Zenoh
//! has two of these threads, and not more than one of them sends answers at a time, so that the other goes on.
//!
//! Where many queries are under way, many are read from a link together. To answer each before the next is looked at would
//! have Zenoh's other threads wake up for each of them, to write its answer and to keep its time, where else they wake up
//! for many. So what is read together is answered together, when nothing more can be read.

use std::{collections::HashMap, sync::Arc, task::Poll, time::Duration};

use futures_util::future::BoxFuture;
use parking_lot::Mutex;
use tokio::{runtime::Handle, task};

use super::answer::Response;
use crate::latency_gate::LatencyGate;

/// As long as searches take less of late, they are not worth another thread.
const BRIEF: Duration = Duration::from_micros(50);

/// The largest payload, of a query or an answer. Who has so many of larger ones under way that they fill the links both
/// ways would wait for answers to be sent, which wait for it to read them.
pub(super) const MAX_BYTES: usize = 4096;

/// How many queries are answered together at most: the first of them waits for the others.
const TOGETHER: usize = 16;

/// A query on its way to its answer.
pub(super) type Answering = BoxFuture<'static, Response>;

/// See the module.
pub(super) struct Inline {
    /// Where is done what is not done here.
    runtime: Handle,
    brevity: LatencyGate,
    /// What waits until the task that reads the link has nothing more to read. Never that of two links together: the
    /// answers to one of them may have to wait.
    waiting: Mutex<HashMap<task::Id, Vec<Answering>>>,
    sending: Mutex<()>,
}

impl Inline {
    pub(super) fn new(runtime: Handle) -> Self {
        Self {
            runtime,
            brevity: LatencyGate::new(BRIEF),
            waiting: Mutex::default(),
            sending: Mutex::default(),
        }
    }

    /// Answers a query that was just read from a link; here, if that takes no longer than hoped.
    pub(super) fn answer(self: &Arc<Self>, answering: Answering) {
        // The task that reads the link is the one that runs.
        let Some(reader) = task::try_id() else {
            return self.answer_elsewhere(answering);
        };
        let mut waiting = self.waiting.lock();
        let of_link = waiting.entry(reader).or_default();
        of_link.push(answering);
        match of_link.len() {
            1 => {
                let inline = Arc::clone(self);
                // On this thread, as soon as the task that reads the link waits for more.
                task::spawn(async move { inline.answer_waiting(reader) });
            }
            TOGETHER.. => {
                drop(waiting);
                self.answer_waiting(reader);
            }
            _ => {}
        }
    }

    fn answer_waiting(self: &Arc<Self>, reader: task::Id) {
        let waiting = self.waiting.lock().remove(&reader).unwrap_or_default();
        let mut all = Vec::with_capacity(waiting.len());
        // The timers they may start belong to where they are awaited.
        let in_runtime = self.runtime.enter();
        for mut answering in waiting {
            match self.brevity.attempt(answering.as_mut()) {
                Poll::Ready(answered) if answered.bytes() <= MAX_BYTES => all.push(answered),
                Poll::Ready(answered) => self.send_elsewhere(vec![answered]),
                // It had to wait, or has computed for as long as a call may without letting others on.
                Poll::Pending => self.answer_elsewhere(answering),
            }
        }
        drop(in_runtime);
        self.send(all);
    }

    /// Sends answers from this thread, one of Zenoh's, unless another of them is at it.
    pub(super) fn send(&self, all: Vec<Response>) {
        match self.sending.try_lock() {
            Some(_only_one) => send(all),
            None => self.send_elsewhere(all),
        }
    }

    /// Answers a query on another thread.
    pub(super) fn answer_elsewhere(self: &Arc<Self>, answering: Answering) {
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
