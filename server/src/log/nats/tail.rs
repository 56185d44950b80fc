//! A look at the end of a stream. It tells a follower without messages whether the stream has lost the newest known record, or
//! has records that the subscription does not bring: a damaged or stalled replica hides them without an error.

use std::time::Duration;

use crate::log::{Digest, RecordPosition};

/// A follower looks at the end of the stream after this time without a message. An idle follower pulls every two seconds, so a
/// look adds one request to 15. A server with 10,000 idle indices looks 333 times a second; with 10 s it would look 1,000
/// times, which is a load on NATS for a rare fault.
pub(super) const LOOK_INTERVAL: Duration = Duration::from_secs(30);

/// The follower subscribes again at this look in turn that finds newer records. At the first, a message may be on its way.
const SUBSCRIBING_LOOK: u32 = 2;

/// From this look in turn on the follower reads the records itself: the new subscription has had two looks as well.
const READING_LOOK: u32 = 4;

/// The next step of a follower after a look.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum AfterLook {
    /// It waits for the next message.
    Wait,
    /// It subscribes again, which compares its place with the stream once more.
    Subscribe,
    /// It reads the next records without a subscription.
    Read,
}

/// The looks of a follower since its last record.
#[derive(Debug, Default)]
pub(super) struct TailLooks {
    /// The number of looks in turn that found newer records.
    ahead: u32,
}

impl TailLooks {
    /// Notes the last record of the stream. The follower's newest record has the revision `after`, and this digest if it is
    /// known.
    pub(super) fn note(
        &mut self,
        after: u64,
        digest: Option<Digest>,
        end: RecordPosition,
    ) -> AfterLook {
        if end.revision > after {
            self.ahead = self.ahead.saturating_add(1);
            return match self.ahead {
                READING_LOOK.. => AfterLook::Read,
                SUBSCRIBING_LOOK => AfterLook::Subscribe,
                _ => AfterLook::Wait,
            };
        }
        self.ahead = 0;
        let is_same = end.revision == after && digest.is_none_or(|digest| digest == end.digest);
        match is_same {
            true => AfterLook::Wait,
            false => AfterLook::Subscribe,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{AfterLook::*, *};

    const DIGEST: Digest = [1; 32];

    /// The steps of a follower with record 5 after each of these looks.
    fn after_looks(looks: &[(u64, u8)]) -> Vec<AfterLook> {
        let mut tail = TailLooks::default();
        let looks = looks.iter().map(|&(revision, byte)| {
            let digest = [byte; 32];
            tail.note(5, Some(DIGEST), RecordPosition { revision, digest })
        });
        looks.collect()
    }

    #[test]
    fn a_follower_at_the_end_waits() {
        assert_eq!(after_looks(&[(5, 1), (5, 1), (5, 1)]), [Wait; 3]);
        let end = RecordPosition {
            revision: 5,
            digest: [2; 32],
        };
        assert_eq!(TailLooks::default().note(5, None, end), Wait);
    }

    #[test]
    fn a_follower_whose_newest_record_is_gone_or_replaced_compares_its_place_at_once() {
        assert_eq!(after_looks(&[(4, 1), (0, 0), (5, 2)]), [Subscribe; 3]);
    }

    #[test]
    fn a_follower_without_the_newest_records_subscribes_again_and_then_reads_them() {
        let looks = [(6, 2), (6, 2), (7, 3), (7, 3), (9, 4)];
        assert_eq!(after_looks(&looks), [Wait, Subscribe, Wait, Read, Read]);
        // Only looks in turn count.
        let looks = [(6, 2), (5, 1), (6, 2), (6, 2)];
        assert_eq!(after_looks(&looks), [Wait, Wait, Wait, Subscribe]);
    }
}
