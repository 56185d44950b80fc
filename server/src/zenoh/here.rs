//! What is answered on the thread that it arrives on, one of Zenoh's: to hand a search that takes microseconds to another
//! thread, and its answer to yet another, costs many times as much.
//!
//! These threads read all links, and must not be kept. So it is done only where nothing is waited for: a search that is
//! brief, of a small query, whose answer is small, too. That a link takes the answer cannot be known beforehand: Zenoh
//! has two of these threads, and not more than one of them sends answers at a time, so that the other goes on.

use std::{
    pin::Pin,
    sync::Mutex,
    task::{Context, Poll, Waker},
    time::{Duration, Instant},
};

use tokio::runtime::Handle;

use crate::brevity::Brevity;

/// As long as searches take less of late, they are not worth another thread.
const BRIEF: Duration = Duration::from_micros(50);

/// The largest payload, of a query or an answer. Who has so many of larger ones under way that they fill the links both
/// ways would wait for answers to be sent, which wait for it to read them.
pub(super) const MAX_BYTES: usize = 4096;

/// See the module.
pub(super) struct Here {
    brevity: Brevity,
    sending: Mutex<()>,
}

impl Here {
    pub(super) fn new() -> Self {
        Self {
            brevity: Brevity::new(BRIEF),
            sending: Mutex::new(()),
        }
    }

    /// The answer, if it does not take long. Where it is not ready it is to be awaited: it had to wait for something, or
    /// has computed for as long as a call may without letting others on.
    pub(super) fn try_answer<F: Future>(
        &self,
        runtime: &Handle,
        answering: Pin<&mut F>,
    ) -> Poll<F::Output> {
        if !self.brevity.expected() {
            return Poll::Pending;
        }
        let began = Instant::now();
        // The timers it may start belong to where it is awaited. So does its waker: whoever polls it next has another.
        let in_runtime = runtime.enter();
        let polled = answering.poll(&mut Context::from_waker(Waker::noop()));
        drop(in_runtime);
        self.brevity.took(began.elapsed());
        polled
    }

    /// Sends an answer, or gives it back while another thread does.
    pub(super) fn try_send<A>(&self, answer: A, send: impl FnOnce(A)) -> Result<(), A> {
        match self.sending.try_lock() {
            Ok(_only_one) => {
                send(answer);
                Ok(())
            }
            Err(_) => Err(answer),
        }
    }
}
