//! The subscribers of an index, by the revision that each has.

use std::sync::{
    Arc, Weak,
    atomic::{AtomicU64, Ordering::Relaxed},
};

use parking_lot::Mutex;

/// The subscribers of one index.
#[derive(Debug, Default)]
pub(crate) struct Subscribers(Mutex<Vec<Weak<AtomicU64>>>);

/// A subscriber. It counts until it is dropped.
#[derive(Debug)]
pub struct Subscriber(Arc<AtomicU64>);

impl Subscriber {
    /// Notes that the subscriber has all records up to this revision.
    pub fn advance_to(&self, revision: u64) {
        self.0.store(revision, Relaxed);
    }
}

impl Subscribers {
    /// A new subscriber that has `revision`.
    pub(crate) fn join(&self, revision: u64) -> Subscriber {
        let subscriber = Arc::new(AtomicU64::new(revision));
        let mut subscribers = self.0.lock();
        subscribers.retain(|it| it.strong_count() > 0);
        subscribers.push(Arc::downgrade(&subscriber));
        Subscriber(subscriber)
    }

    /// The number of subscribers, and the records that the last of them does not have of those up to `newest`.
    pub(crate) fn count_and_lag(&self, newest: u64) -> (usize, u64) {
        let subscribers = self.0.lock();
        let revisions = subscribers.iter().filter_map(Weak::upgrade);
        let lags = revisions.map(|at| newest.saturating_sub(at.load(Relaxed)));
        lags.fold((0, 0), |(count, most), lag| (count + 1, most.max(lag)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lag_is_that_of_the_last_subscriber_that_is_left() {
        let subscribers = Subscribers::default();
        assert_eq!(subscribers.count_and_lag(9), (0, 0));
        let first = subscribers.join(2);
        let second = subscribers.join(5);
        assert_eq!(subscribers.count_and_lag(9), (2, 7));
        first.advance_to(8);
        assert_eq!(subscribers.count_and_lag(9), (2, 4));
        drop(second);
        assert_eq!(subscribers.count_and_lag(9), (1, 1));
        assert_eq!(subscribers.count_and_lag(7), (1, 0));
    }
}
