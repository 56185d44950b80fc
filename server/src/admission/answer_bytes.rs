//! The bytes of an answer while it is made.

use std::sync::Arc;

use super::HeldBytes;

/// An answer takes no room up to this size: [`CALL_BYTES`](super::CALL_BYTES) covers a small one.
const SMALL_BYTES: usize = 16 * 1024;

/// The refusal of an answer while calls hold as many bytes as they may: this number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct TooManyBytes(pub(crate) usize);

/// The bytes that an answer holds in the budgets of its call's flow while it is made. Its face counts the encoded answer, so the drop
/// gives them back.
#[derive(Debug, Default)]
pub(crate) struct AnswerBytes {
    /// The bytes of the call; None: nothing bounds the answer.
    call: Option<Arc<HeldBytes>>,
    /// The size of the answer so far.
    made: usize,
    /// The bytes held for it: none, or a power of two, because columns double while they grow.
    held: usize,
}

impl AnswerBytes {
    /// An empty answer.
    pub(crate) fn of(call: Option<Arc<HeldBytes>>) -> Self {
        Self {
            call,
            made: 0,
            held: 0,
        }
    }

    /// It may hold this many bytes beside a request of any size: the greatest power of two in the share of its flow.
    pub(crate) fn most(&self) -> usize {
        let share = self.call.as_ref().map(|call| call.flow().own.max());
        let bits = share.and_then(usize::checked_ilog2);
        bits.map_or(usize::MAX, |bits| 1 << bits)
    }

    /// Adds `bytes` to the answer, and holds more if it has outgrown what it holds.
    pub(crate) fn take(&mut self, bytes: usize) -> Result<(), TooManyBytes> {
        self.made = self.made.saturating_add(bytes);
        if self.made <= self.held.max(SMALL_BYTES) {
            return Ok(());
        }
        let Some(call) = &self.call else {
            return Ok(());
        };
        let size = self.made.checked_next_power_of_two();
        let size = size.unwrap_or(usize::MAX);
        if !call.grow(self.held, size) {
            return Err(TooManyBytes(call.flow().max_bytes()));
        }
        self.held = size;
        Ok(())
    }

    /// Gives back all bytes: the answer begins anew.
    pub(crate) fn clear(&mut self) {
        if let Some(call) = &self.call
            && self.held > 0
        {
            call.release(self.held);
        }
        (self.made, self.held) = (0, 0);
    }
}

impl Drop for AnswerBytes {
    fn drop(&mut self) {
        self.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        admission::{Admission, AdmissionConfig, Flow},
        config::Config,
    };

    const MIB: usize = 1024 * 1024;

    /// All flows hold at most 64 MiB, and one holds at most 16 MiB.
    fn admission() -> Admission {
        let config = AdmissionConfig {
            max_bytes: 64 * MIB,
            ..Config::default().admission
        };
        Admission::new(&config, 1, 0)
    }

    fn answer_of(flow: &Arc<Flow>) -> AnswerBytes {
        AnswerBytes::of(Some(Arc::new(flow.hold())))
    }

    /// Grows an answer by a kilobyte at a time up to `most` bytes, or to its refusal. Returns its size.
    fn grow(answer: &mut AnswerBytes, most: usize) -> usize {
        while answer.made < most && answer.take(1024).is_ok() {}
        answer.made
    }

    fn refused(admission: &Admission) -> u64 {
        admission.refused(0)[1].1
    }

    #[test]
    fn a_small_answer_takes_nothing_and_a_larger_one_its_size() {
        let admission = admission();
        let flow = admission.open();
        let mut answer = answer_of(&flow);
        answer.take(SMALL_BYTES).unwrap();
        assert_eq!(flow.held(), 0);
        answer.take(1).unwrap();
        assert_eq!(flow.held(), 2 * SMALL_BYTES);
        answer.take(MIB).unwrap();
        assert_eq!(flow.held(), 2 * MIB);
        answer.clear();
        assert_eq!((flow.held(), admission.bytes().0), (0, 0));
        answer.take(MIB).unwrap();
        drop(answer);
        assert_eq!((flow.held(), admission.bytes().0), (0, 0));
    }

    #[test]
    fn without_a_call_nothing_bounds_an_answer() {
        let mut answer = AnswerBytes::of(None);
        answer.take(usize::MAX).unwrap();
        answer.take(1).unwrap();
    }

    #[test]
    fn answers_that_outgrow_the_room_of_their_flow_are_refused_and_give_everything_back() {
        let admission = admission();
        let flow = admission.open();
        let mut answers: Vec<_> = (0..512).map(|_| answer_of(&flow)).collect();
        // All of them grow together.
        let (mut size, mut most) = (0, 0);
        while size < 4 * MIB {
            size += 64 * 1024;
            answers.retain_mut(|answer| answer.take(64 * 1024).is_ok());
            most = most.max(flow.held());
        }
        // Beside each answer that grew, the flow held its share at most.
        assert!(most <= 16 * MIB + 4 * MIB, "{most}");
        assert!(answers.len() >= 4, "{}", answers.len());
        assert_eq!(refused(&admission), 512 - answers.len() as u64);
        assert_eq!(flow.held(), answers.len() * 4 * MIB);
        drop(answers);
        assert_eq!((flow.held(), admission.bytes().0), (0, 0));
        assert_eq!(grow(&mut answer_of(&flow), 4 * MIB), 4 * MIB);
    }

    /// An eighth of all bytes is for flows that hold little.
    #[test]
    fn a_large_answer_that_grows_in_small_steps_is_judged_by_its_size() {
        let admission = admission();
        let (other, flow) = (admission.open().hold(), admission.open());
        // More than the half that a flow with much may take, and less than the seven eighths for one large answer.
        other.force_take(40 * MIB);
        assert_eq!(grow(&mut answer_of(&flow), 4 * MIB), 4 * MIB);
        other.force_take(18 * MIB);
        let little = admission.little();
        let size = grow(&mut answer_of(&flow), 4 * MIB);
        assert!((little..=little + 1024).contains(&size), "{size}");
        assert_eq!((flow.held(), refused(&admission)), (0, 1));
        assert_eq!(grow(&mut answer_of(&flow), little), little);
    }

    #[test]
    fn an_answer_exceeds_its_room_by_a_message_at_most() {
        let admission = admission();
        let flow = admission.open();
        let mut answer = answer_of(&flow);
        assert_eq!(answer.most(), 16 * MIB);
        let size = grow(&mut answer, 64 * MIB);
        assert!(size <= 16 * MIB + 1024, "{size}");
        assert_eq!(flow.held(), 16 * MIB);
    }

    /// A request may be as large as the share of its flow, and each of these calls would be refused for ever.
    #[test]
    fn an_answer_is_not_refused_for_its_own_request() {
        let config = AdmissionConfig {
            max_bytes: 0,
            ..Config::default().admission
        };
        let admission = Admission::new(&config, 1, 4 * MIB);
        let call = Arc::new(admission.open().hold());
        assert!(call.take(4 * MIB));
        let mut answer = AnswerBytes::of(Some(call));
        assert_eq!(grow(&mut answer, 4 * MIB), 4 * MIB);
    }
}
