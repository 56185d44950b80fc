//! The places of calls: they bound the calls that are under way.
//!
//! A flow may take half of the places that are left, so ten flows can take all of them. Calls that only wait for a revision
//! could keep them until their deadlines. So a call whose flow may take no free place gets the place of such a call, if the
//! flow of that call has more calls under way than its own.

use std::{
    cmp::Reverse,
    collections::BTreeMap,
    fmt, mem,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
};

use parking_lot::Mutex;
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore};

use super::Flow;

/// A flow loses a place only to a flow with at least this many fewer calls under way, or to one without any. With a lead of one,
/// two flows would take a place from each other in turns.
const MIN_LEAD: usize = 2;

/// See the module.
#[derive(Debug)]
pub(crate) struct CallPlaces {
    free: Arc<Semaphore>,
    waiting: Mutex<WaitingCalls>,
}

/// The calls that only wait.
#[derive(Debug, Default)]
struct WaitingCalls {
    /// The number of the next wait.
    next: u64,
    /// The places of the calls, by the number of the wait: the first has waited for the longest time.
    places: BTreeMap<u64, Arc<CallPlace>>,
}

/// The place of a call.
pub struct CallPlace {
    all: Arc<CallPlaces>,
    flow: Arc<Flow>,
    /// None once the call has ended.
    permit: Mutex<Option<OwnedSemaphorePermit>>,
    /// Changes under the lock of the waiting calls.
    is_lost: AtomicBool,
    lost: Notify,
}

/// A call only waits until this is dropped.
#[derive(Debug)]
pub(crate) struct PlaceWait {
    number: u64,
    place: Arc<CallPlace>,
}

/// There is no place for a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NoPlace {
    /// Its flow would have more than it leaves to the others.
    OfFlow,
    /// All are taken.
    OfAll,
}

impl CallPlaces {
    /// Places for `limit` calls.
    pub(crate) fn new(limit: usize) -> Arc<Self> {
        Arc::new(Self {
            free: Arc::new(Semaphore::new(limit.min(Semaphore::MAX_PERMITS))),
            waiting: Mutex::default(),
        })
    }

    /// The number of free places.
    pub(crate) fn free(&self) -> usize {
        self.free.available_permits()
    }

    /// A place for a call of `flow`. If the flow may take no free one, a call that only waits [loses](CallPlace::lost) its place,
    /// and holds a permit of `exits` instead until its refusal is sent.
    pub(crate) fn take(
        self: &Arc<Self>,
        flow: &Arc<Flow>,
        exits: &Arc<Semaphore>,
    ) -> Result<Arc<CallPlace>, NoPlace> {
        let free = self.free();
        // A flow has no more places than it leaves to the others.
        let is_greedy = flow.under_way() > free;
        let permit = match free {
            0 => self.take_from_waiting(flow, exits),
            _ if is_greedy => self.take_from_waiting(flow, exits),
            _ => Arc::clone(&self.free).try_acquire_owned().ok(),
        };
        let Some(permit) = permit else {
            return Err(match is_greedy {
                true => NoPlace::OfFlow,
                false => NoPlace::OfAll,
            });
        };
        Ok(Arc::new(CallPlace {
            all: Arc::clone(self),
            flow: Arc::clone(flow),
            permit: Mutex::new(Some(permit)),
            is_lost: AtomicBool::new(false),
            lost: Notify::new(),
        }))
    }

    /// The permit of the waiting call whose flow has the most calls under way. Among the calls of that flow it is the one that
    /// has waited for the longest time.
    fn take_from_waiting(
        &self,
        newcomer: &Flow,
        exits: &Arc<Semaphore>,
    ) -> Option<OwnedSemaphorePermit> {
        let exit = Arc::clone(exits).try_acquire_owned().ok()?;
        let least = match newcomer.under_way() {
            0 => 1,
            under_way => under_way.saturating_add(MIN_LEAD),
        };
        let mut waiting = self.waiting.lock();
        let counted = waiting.places.iter();
        let counted = counted.map(|(&number, place)| (place.flow.under_way(), number));
        let (_, number) = counted
            .filter(|&(under_way, _)| under_way >= least)
            .min_by_key(|&(under_way, number)| (Reverse(under_way), number))?;
        let place = waiting.places.remove(&number)?;
        // From now on it holds an exit, and no place.
        place.is_lost.store(true, Relaxed);
        drop(waiting);
        let mut held = place.permit.lock();
        let permit = mem::replace(held.as_mut()?, exit);
        place.lost.notify_one();
        Some(permit)
    }
}

impl CallPlace {
    /// Notes that the call only waits: it may lose its place until the result is dropped.
    pub(crate) fn wait(self: &Arc<Self>) -> PlaceWait {
        let mut waiting = self.all.waiting.lock();
        let number = waiting.next;
        waiting.next += 1;
        if !self.is_lost.load(Relaxed) {
            waiting.places.insert(number, Arc::clone(self));
        }
        drop(waiting);
        PlaceWait {
            number,
            place: Arc::clone(self),
        }
    }

    /// Returns once another call has the place. Only one task may wait for it.
    pub(crate) async fn lost(&self) {
        self.lost.notified().await;
    }

    /// The permit of a call that has ended: that of its place, or the one that it holds instead.
    pub(crate) fn end(&self) -> Option<OwnedSemaphorePermit> {
        self.permit.lock().take()
    }
}

/// It names no others: they name it.
impl fmt::Debug for CallPlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("CallPlace").finish_non_exhaustive()
    }
}

impl Drop for PlaceWait {
    fn drop(&mut self) {
        let removed = self.place.all.waiting.lock().places.remove(&self.number);
        // It may be the last one and then ends the flow: not under the lock.
        drop(removed);
    }
}

#[cfg(test)]
mod tests {
    use std::pin::pin;

    use futures_util::poll;

    use super::*;
    use crate::{
        admission::{Admission, HeldBytes},
        config::Config,
    };

    const PLACES: usize = 1024;

    /// The calls of flows that take all places one after the other.
    fn take_all(
        admission: &Admission,
        places: &Arc<CallPlaces>,
    ) -> Vec<Vec<(HeldBytes, Arc<CallPlace>)>> {
        // No call loses its place without an exit.
        let no_exits = Arc::new(Semaphore::new(0));
        let mut flows = Vec::new();
        while places.free() > 0 {
            let flow = admission.open();
            let mut calls = Vec::new();
            while let Ok(place) = places.take(&flow, &no_exits) {
                calls.push((flow.hold(), place));
            }
            flows.push(calls);
        }
        flows
    }

    #[tokio::test]
    async fn flows_that_hold_all_places_and_wait_leave_one_to_another() {
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let places = CallPlaces::new(PLACES);
        let flows = take_all(&admission, &places);
        assert_eq!(flows.len(), 10);
        let all: usize = flows.iter().map(Vec::len).sum();
        assert_eq!(all, PLACES);
        let exits = Arc::new(Semaphore::new(1));
        let newcomer = admission.open();
        let computing = places.take(&newcomer, &exits).err();
        assert_eq!(computing, Some(NoPlace::OfAll), "no call waits");

        let waits: Vec<_> = flows.iter().flatten().map(|(_, it)| it.wait()).collect();
        let most = &flows[0];
        let flow = most[0].0.flow();
        let own = places.take(flow, &exits).err();
        assert_eq!(own, Some(NoPlace::OfFlow), "its flow has the most");
        let place = places.take(&newcomer, &exits).unwrap();
        assert!(poll!(pin!(most[0].1.lost())).is_ready());
        for (_, kept) in flows.iter().flatten().skip(1) {
            assert!(poll!(pin!(kept.lost())).is_pending());
        }

        // The call that lost its place holds the only exit until its refusal is sent.
        let late = places.take(&newcomer, &exits).err();
        assert_eq!(late, Some(NoPlace::OfAll));
        drop(most[0].1.end());
        assert_eq!(exits.available_permits(), 1);
        drop(waits);
        assert!(places.waiting.lock().places.is_empty());
        // The next call gets the free place.
        drop(place.end());
        assert_eq!(places.free(), 1);
        places.take(&newcomer, &exits).unwrap();
    }

    #[tokio::test]
    async fn flows_with_one_call_take_no_place_from_each_other_but_leave_one_to_a_newcomer() {
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let places = CallPlaces::new(2);
        let exits = Arc::new(Semaphore::new(1));
        let (first, second) = (admission.open(), admission.open());
        let held = places.take(&first, &exits).unwrap();
        let other = places.take(&second, &exits).unwrap();
        let _calls = [first.hold(), second.hold()];
        let _waits = [held.wait(), other.wait()];
        let third = admission.open();
        let one_call = third.hold();
        let refused = places.take(&third, &exits).err();
        assert_eq!(refused, Some(NoPlace::OfFlow));
        assert_eq!(exits.available_permits(), 1);
        drop(one_call);
        places.take(&third, &exits).unwrap();
        assert!(poll!(pin!(held.lost())).is_ready());
        assert!(poll!(pin!(other.lost())).is_pending());
    }
}
