//! The bytes of one call in the budgets of its flow and of all flows.

use std::{
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering::Relaxed},
    },
    time::Duration,
};

use tokio::time::{Instant, sleep_until, timeout};

use super::Flow;

/// The first pause of a call that waits for room. Pauses double up to the longest, as thousands may wait.
const MIN_PAUSE: Duration = Duration::from_millis(5);
const MAX_PAUSE: Duration = Duration::from_millis(200);

/// The longest wait for room. A client that reads the streams of a connection one after the other, and has unread parts of
/// too many, would wait for itself.
const MAX_WAIT: Duration = Duration::from_secs(10);

/// The bytes that a call holds, until it is dropped.
#[derive(Debug)]
pub struct HeldBytes {
    flow: Arc<Flow>,
    held: AtomicUsize,
    /// False for further bytes of a call.
    is_call: bool,
}

impl HeldBytes {
    pub(super) fn new(flow: Arc<Flow>) -> Self {
        flow.under_way.fetch_add(1, Relaxed);
        Self {
            flow,
            held: AtomicUsize::new(0),
            is_call: true,
        }
    }

    /// Begins to count further bytes of the same call, which are given back on their own.
    pub(crate) fn further(&self) -> Self {
        Self {
            flow: Arc::clone(&self.flow),
            held: AtomicUsize::new(0),
            is_call: false,
        }
    }

    /// Holds more bytes; false if there is no room for them, which counts as a refusal.
    #[must_use]
    pub(crate) fn take(&self, bytes: usize) -> bool {
        let taken = self.try_take(bytes);
        if !taken {
            self.flow.all.refuse();
        }
        taken
    }

    /// Like [`HeldBytes::take`], but a lack of room counts as no refusal: the call may wait and try again.
    #[must_use]
    pub(crate) fn try_take(&self, bytes: usize) -> bool {
        let Flow { all, own, .. } = &*self.flow;
        // A large request arrives in pieces, and those that it holds already do not make its flow greedy.
        let before = self.held.load(Relaxed);
        let most = self.flow.most_of_all(before, before.saturating_add(bytes));
        if !all.try_take_within(most, bytes) {
            return false;
        }
        if !own.try_take(bytes) {
            all.release(bytes);
            return false;
        }
        self.held.fetch_add(bytes, Relaxed);
        true
    }

    /// Lets an answer that holds `before` bytes of this call hold `size`; false if there is no room for it, which counts as a
    /// refusal. As in [`HeldBytes::has_room`], the bytes beside the answer decide, so no answer of the size of a message is too
    /// large by itself.
    #[must_use]
    pub(crate) fn grow(&self, before: usize, size: usize) -> bool {
        let Flow {
            all, own, slack, ..
        } = &*self.flow;
        let most = self.flow.most_of_all(before, size);
        let (more, slack) = (size.saturating_sub(before), size.min(*slack));
        if !all.try_take_within(most.saturating_add(slack), more) {
            all.refuse();
            return false;
        }
        if !own.try_take_within(own.max().saturating_add(slack), more) {
            all.release(more);
            all.refuse();
            return false;
        }
        self.held.fetch_add(more, Relaxed);
        true
    }

    /// Waits until the flow may hold `bytes` more, for [`MAX_WAIT`] at most, and holds them then. Otherwise it returns false and
    /// counts a refusal. The call does not wait for the bytes that it holds itself.
    #[must_use]
    pub(crate) async fn wait_for(&self, bytes: usize) -> bool {
        let waited = timeout(MAX_WAIT, self.room(bytes)).await;
        match waited {
            Ok(()) => self.force_take(bytes),
            Err(_) => self.flow.all.refuse(),
        }
        waited.is_ok()
    }

    /// Waits until the flow may hold `bytes` more.
    pub(crate) async fn room(&self, bytes: usize) {
        let mut pause = MIN_PAUSE;
        while !self.has_room(bytes) {
            sleep_until(Instant::now() + pause).await;
            pause = (2 * pause).min(MAX_PAUSE);
        }
    }

    /// Holds bytes that exist already, with room or without.
    pub(crate) fn force_take(&self, bytes: usize) {
        self.flow.all.force_take(bytes);
        self.flow.own.force_take(bytes);
        self.held.fetch_add(bytes, Relaxed);
    }

    /// Gives back all bytes.
    pub(crate) fn release_all(&self) {
        self.release(self.held.load(Relaxed));
    }

    /// Gives back all bytes but `kept`.
    pub(crate) fn release_down_to(&self, kept: usize) {
        self.release(self.held.load(Relaxed).saturating_sub(kept));
    }

    /// Gives back some of the bytes.
    pub(crate) fn release(&self, bytes: usize) {
        self.held.fetch_sub(bytes, Relaxed);
        self.flow.own.release(bytes);
        self.flow.all.release(bytes);
    }

    /// Returns false, and counts a refusal, if the flow may not hold `bytes` more: clients have not read their answers.
    pub(crate) fn check_room(&self, bytes: usize) -> bool {
        let has_room = self.has_room(bytes);
        if !has_room {
            self.flow.all.refuse();
        }
        has_room
    }

    /// True if the flow may begin to hold `bytes` more. The bytes that it and all hold beside these decide, so no message is too
    /// large by itself.
    pub(crate) fn has_room(&self, bytes: usize) -> bool {
        let Flow { all, own, .. } = &*self.flow;
        let before = self.held.load(Relaxed);
        let most = self.flow.most_of_all(before, bytes);
        own.held().saturating_sub(before) <= own.max() && all.held().saturating_sub(before) <= most
    }

    /// The flow of the call.
    pub(crate) fn flow(&self) -> &Arc<Flow> {
        &self.flow
    }
}

impl Drop for HeldBytes {
    fn drop(&mut self) {
        self.release_all();
        if self.is_call {
            self.flow.under_way.fetch_sub(1, Relaxed);
        }
    }
}
