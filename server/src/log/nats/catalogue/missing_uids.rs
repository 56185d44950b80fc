//! Uids that callers name and the bucket's leader does not.

use std::{collections::VecDeque, time::Duration};

use tokio::time::Instant;

use crate::log::Uid;

/// The most uids that are remembered.
const MAX_UIDS: usize = 1000;

/// An index, by its name and uid.
type Asked = (String, Uid);

/// The uids with the first and the last time at which the leader did not name them, oldest first.
#[derive(Default)]
pub(super) struct MissingUids(VecDeque<(Asked, Instant, Instant)>);

impl MissingUids {
    /// The leader was asked.
    pub(super) fn note(&mut self, asked: Asked, is_named: bool) {
        let now = Instant::now();
        match self.0.iter().position(|(it, ..)| *it == asked) {
            Some(at) if is_named => drop(self.0.remove(at)),
            Some(at) => self.0[at].2 = now,
            None if is_named => {}
            None => {
                self.0.push_back((asked, now, now));
                if self.0.len() > MAX_UIDS {
                    self.0.pop_front();
                }
            }
        }
    }

    /// The time for which the leader is known not to name it.
    pub(super) fn time(&self, asked: &Asked) -> Duration {
        let found = self.0.iter().find(|(it, ..)| it == asked);
        found.map_or(Duration::ZERO, |(_, first, last)| *last - *first)
    }
}

#[cfg(test)]
mod tests {
    use tokio::time::advance;

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_uid_is_missing_between_two_answers_without_it() {
        const SECOND: Duration = Duration::from_secs(1);
        let asked = ("arm".to_owned(), Uid::unique());
        let mut missing = MissingUids::default();
        missing.note(asked.clone(), false);
        advance(SECOND).await;
        assert_eq!(missing.time(&asked), Duration::ZERO);
        missing.note(asked.clone(), false);
        assert_eq!(missing.time(&asked), SECOND);
        assert_eq!(missing.time(&("leg".to_owned(), asked.1)), Duration::ZERO);
        missing.note(asked.clone(), true);
        missing.note(asked.clone(), false);
        assert_eq!(missing.time(&asked), Duration::ZERO);
        for _ in 0..MAX_UIDS {
            missing.note(("arm".to_owned(), Uid::unique()), false);
        }
        assert_eq!(missing.0.len(), MAX_UIDS);
        assert_ne!(missing.0[0].0, asked);
    }
}
