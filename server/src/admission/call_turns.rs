//! The turns of a call: its work is polled in slices, each in a turn.

use std::{
    cell::Cell,
    future::poll_fn,
    mem,
    pin::{Pin, pin},
    sync::Arc,
    task::{Context, Poll, Waker, ready},
    time::{Duration, Instant},
};

use tokio::task::yield_now;

use super::{
    Flow, Overloaded,
    turns::{MAX_AT_ONCE, MAX_WHOLE, Stage, TurnRequest},
};

/// The turns of one call, one for each slice of its work.
#[derive(Debug)]
pub(crate) struct CallTurns {
    flow: Arc<Flow>,
    stage: Stage,
    /// Its work since it last went behind others of its flow.
    at_once: Duration,
    /// The turn of the next slice.
    next: Option<TurnRequest>,
    /// True if the call has the turn of its next slice and has yielded with it.
    has_yielded: bool,
    /// True until the call has yielded once with a long turn, so that bytes are read between two calls.
    looks_for_bytes: bool,
    /// The time since which it waits for that turn.
    requested_at: Instant,
    /// The time that it has waited for turns.
    queued: Duration,
    /// The time that it has had in turns.
    computed: Duration,
}

thread_local! {
    /// The waker of work that is about to be pending and can go on at once.
    static GOES_ON: Cell<Option<Waker>> = const { Cell::new(None) };
}

/// Ends a slice of work that goes on: others may have a turn before.
pub(crate) async fn end_slice() {
    poll_fn(|context| {
        GOES_ON.set(Some(context.waker().clone()));
        Poll::Ready(())
    })
    .await;
    yield_now().await;
}

impl CallTurns {
    pub(super) fn new(flow: Arc<Flow>) -> Self {
        Self {
            flow,
            stage: Stage::New,
            at_once: Duration::ZERO,
            next: None,
            has_yielded: false,
            looks_for_bytes: true,
            requested_at: Instant::now(),
            queued: Duration::ZERO,
            computed: Duration::ZERO,
        }
    }

    /// The turns of a request of a stream that has begun: it is not refused, and goes after those that came before it.
    pub(super) fn of_stream(self) -> Self {
        Self {
            stage: Stage::Demoted,
            looks_for_bytes: false,
            ..self
        }
    }

    /// Asks for the next turn: it is kept for the call, or the call waits for it from now on.
    pub(crate) fn request(&mut self) -> Result<(), Overloaded> {
        if self.next.is_none() {
            let Flow { turns, number, .. } = &*self.flow;
            let now = Instant::now();
            self.requested_at = now;
            let behind = self.flow.behind(now);
            self.next = Some(turns.request(*number, self.stage, behind, now)?);
        }
        Ok(())
    }

    /// The time that the call has waited for turns, and the time that it has had in them.
    pub(crate) fn times(&self) -> (Duration, Duration) {
        (self.queued, self.computed)
    }

    /// Gives up the turn that was requested.
    pub(crate) fn give_up(&mut self) {
        self.next = None;
    }

    /// Polls `work` in a turn. It is pending while the call waits for one, and the task is woken for it.
    pub(crate) fn poll<T>(
        &mut self,
        context: &mut Context<'_>,
        work: impl FnOnce(&mut Context<'_>) -> Poll<T>,
    ) -> Poll<Result<T, Overloaded>> {
        self.request()?;
        if mem::take(&mut self.has_yielded) {
            // The runtime runs a task that yielded before those that read the bytes which came meanwhile: they are next.
            context.waker().wake_by_ref();
            return Poll::Pending;
        }
        if self.stage != Stage::New {
            // Others may have come since the last slice.
            let go_on = |next| match next {
                TurnRequest::Granted(turn) => {
                    let (turns, now) = (&self.flow.turns, Instant::now());
                    turns.yield_turn(turn, Duration::ZERO, self.stage, now)
                }
                waits => waits,
            };
            self.next = self.next.take().map(go_on);
        }
        if let Some(TurnRequest::Waits(granted)) = &mut self.next {
            let granted = ready!(Pin::new(granted).poll(context));
            self.next = None;
            // The sender is dropped only with the flow, which this call keeps.
            let turn = granted.unwrap_or(Err(Overloaded(Duration::ZERO)))?;
            self.next = Some(TurnRequest::Granted(turn));
        }
        let Some(TurnRequest::Granted(turn)) = self.next.take() else {
            return Poll::Pending;
        };
        if turn.is_short() && self.flow.has_long_turns() {
            // A thread has many short turns at a time: the others would wait for the sum of as many long ones. The call has
            // had its turn, so it is not refused.
            self.stage = Stage::Demoted;
            drop(turn);
            let requested_at = self.requested_at;
            self.request()?;
            self.requested_at = requested_at;
            return self.poll(context, work);
        }
        if mem::take(&mut self.looks_for_bytes) && turn.is_long() {
            self.stage = Stage::Begun;
            self.next = Some(TurnRequest::Granted(turn));
            self.has_yielded = true;
            // The task is woken once the runtime has looked for bytes.
            let _ = pin!(yield_now()).poll(context);
            return Poll::Pending;
        }
        GOES_ON.set(None);
        let began = Instant::now();
        self.queued += began - self.requested_at;
        let polled = work(context);
        let took = began.elapsed();
        self.computed += took;
        self.flow.note_slice(took);
        self.requested_at = began + took;
        self.at_once += took;
        self.stage = match self.computed < MAX_WHOLE {
            true => Stage::Begun,
            false => Stage::Resumed,
        };
        if self.at_once >= MAX_AT_ONCE {
            self.at_once = Duration::ZERO;
            self.stage = Stage::Demoted;
        }
        // A task of its own polls its work with another waker.
        let goes_on = GOES_ON
            .take()
            .is_some_and(|waker| waker.will_wake(context.waker()));
        if polled.is_pending() && goes_on {
            let (turns, now) = (&self.flow.turns, self.requested_at);
            let next = turns.yield_turn(turn, took, self.stage, now);
            self.has_yielded = matches!(next, TurnRequest::Granted(_));
            self.next = Some(next);
        } else {
            turn.end(took);
        }
        polled.map(Ok)
    }

    /// Does `work` in turns.
    pub(crate) async fn run<F: Future>(&mut self, work: F) -> Result<F::Output, Overloaded> {
        let mut work = pin!(work);
        poll_fn(|context| self.poll(context, |context| work.as_mut().poll(context))).await
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use futures_util::poll;

    use super::*;
    use crate::{admission::Admission, config::Config};

    #[tokio::test]
    async fn a_call_that_came_during_a_slice_goes_before_the_next_one() {
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let (long, short) = (admission.open(), admission.open());
        let slices = Cell::new(0);
        let mut turns = long.turns();
        let mut long = pin!(turns.run(async {
            loop {
                slices.set(slices.get() + 1);
                end_slice().await;
            }
        }));
        while slices.get() < 1 {
            assert!(poll!(long.as_mut()).is_pending());
        }
        let mut turns = short.turns();
        let mut short = pin!(turns.run(async {}));
        assert!(poll!(short.as_mut()).is_pending());
        for _ in 0..10 {
            assert!(poll!(long.as_mut()).is_pending());
        }
        let mut polls = 0;
        while poll!(short.as_mut()).is_pending() {
            polls += 1;
            assert!(polls < 10, "it has no turn");
        }
        assert_eq!(slices.get(), 1);
        while slices.get() < 2 {
            assert!(poll!(long.as_mut()).is_pending());
        }
    }

    #[tokio::test]
    async fn calls_of_a_short_flow_give_their_turns_back_once_one_was_long() {
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let flow = admission.open();
        for _ in 0..100 {
            flow.turns().run(async {}).await.expect("it is not refused");
        }
        let mut turns: Vec<_> = (0..5).map(|_| flow.turns()).collect();
        for turns in &mut turns {
            turns.request().expect("there is a turn");
        }
        let mut long = turns.remove(0);
        let work = long.run(async {
            let began = Instant::now();
            while began.elapsed() < Duration::from_millis(1) {}
        });
        work.await.expect("it is not refused");
        let order = RefCell::new(Vec::new());
        let calls = turns.iter_mut().enumerate().map(|(number, turns)| {
            let order = &order;
            Box::pin(turns.run(async move { order.borrow_mut().push(number) }))
        });
        let mut calls: Vec<_> = calls.collect();
        for call in &mut calls {
            assert!(poll!(call.as_mut()).is_pending());
        }
        // A thread that reads bytes runs before each of them.
        assert!(poll!(calls[0].as_mut()).is_pending() && order.borrow().is_empty());
        for call in calls {
            call.await.expect("it is not refused");
        }
        assert_eq!(*order.borrow(), [0, 1, 2, 3]);
    }

    #[tokio::test]
    async fn requests_of_a_stream_go_in_their_order() {
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let (other, stream) = (admission.open(), admission.open());
        let mut other = other.turns();
        other.request().expect("there is a turn");
        let order = RefCell::new(Vec::new());
        let requests = (0..4).map(|number| {
            let (mut turns, order) = (stream.turns().of_stream(), &order);
            Box::pin(async move { turns.run(async { order.borrow_mut().push(number) }).await })
        });
        let mut requests: Vec<_> = requests.collect();
        for request in &mut requests {
            assert!(poll!(request.as_mut()).is_pending());
        }
        other.give_up();
        // The last is polled first: the order is that of the queue.
        for _ in 0..4 {
            let mut waiting = Vec::new();
            for mut request in requests.into_iter().rev() {
                if poll!(request.as_mut()).is_pending() {
                    waiting.insert(0, request);
                }
            }
            requests = waiting;
        }
        assert_eq!(*order.borrow(), [0, 1, 2, 3]);
    }
}
