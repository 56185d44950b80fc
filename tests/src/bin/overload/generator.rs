//! Makes calls from one thread over many connections: on a schedule, or a fixed number at a time.

use std::{
    collections::VecDeque,
    net::SocketAddr,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    thread::{self, JoinHandle},
    time::Duration,
};

use bytes::Bytes;
use futures_util::future::join_all;
use http::Request;
use tokio::{
    runtime,
    task::{JoinSet, yield_now},
    time::{Instant, sleep_until, timeout_at},
};
use tonic::Code;

use crate::{
    tally::Tally,
    wire::{self, Client, KNN, LARGE_WINDOW, Outcome},
};

/// The most calls of one connection that wait in the client.
const QUEUE: usize = 1_000;
/// The most calls that begin before the connections are served again.
const BATCH: u64 = 64;
/// The time after a phase in which its calls may still be answered.
const AFTER: Duration = Duration::from_secs(5);
/// A caller in a closed loop pauses this long after a refusal.
const RETRY: Duration = Duration::from_millis(100);
/// The time in which the first connections are made.
const CONNECT: Duration = Duration::from_secs(10);

/// Runs a future on a thread of its own, at a lower priority than the threads that take times.
pub(crate) fn apart<T: Send + 'static>(
    work: impl Future<Output = T> + Send + 'static,
) -> JoinHandle<T> {
    thread::spawn(|| {
        crate::pin::lower_priority();
        let runtime = runtime::Builder::new_current_thread().enable_all().build();
        runtime.expect("a runtime").block_on(work)
    })
}

/// The calls to make.
#[derive(Clone, Debug)]
pub(crate) struct Load {
    pub(crate) address: SocketAddr,
    pub(crate) connections: usize,
    /// The encoded messages of the calls, in turn.
    pub(crate) requests: Arc<Vec<Bytes>>,
    /// The time after which a caller gives up.
    pub(crate) deadline: Option<Duration>,
}

impl Load {
    /// Makes call n at `due(n)` for as long as the phase is, and then waits for the last answers.
    pub(crate) async fn on_schedule(
        self,
        length: Duration,
        due: impl Fn(u64) -> Duration,
    ) -> Tally {
        let calls = Calls::connect(self, length).await;
        let began = calls.began;
        let mut next = 0;
        let mut next_due = began + due(0);
        loop {
            let now = Instant::now();
            if now >= began + length {
                break;
            }
            let batch_end = next + BATCH;
            while next_due <= now && next < batch_end {
                calls.offer(next, next_due);
                next += 1;
                next_due = began + due(next);
            }
            // A timer is up to a millisecond late, so that the last part of the wait goes from poll to poll.
            let early = next_due.min(began + length) - Duration::from_millis(3);
            if early > now {
                sleep_until(early).await;
            } else {
                yield_now().await;
            }
        }
        let end = began + length;
        let mut due_by_end = next;
        while began + due(due_by_end) < end {
            due_by_end += 1;
        }
        lock(&calls.tally).due = due_by_end;
        calls.settled(end + AFTER).await;
        calls.into_tally()
    }

    /// Keeps `in_flight` calls under way for as long as the phase is.
    pub(crate) async fn closed(self, in_flight: u64, length: Duration) -> Tally {
        let calls = Calls::connect(self, length).await;
        let mut callers = JoinSet::new();
        for first in 0..in_flight {
            let calls = Arc::clone(&calls);
            callers.spawn(async move {
                for n in (first..).step_by(in_flight as usize) {
                    let outcome = calls.call_now(n).await;
                    if outcome != Outcome::Status(Code::Ok) {
                        sleep_until(Instant::now() + RETRY).await;
                    }
                }
            });
        }
        let _ = timeout_at(calls.began + length, callers.join_next()).await;
        drop(callers);
        calls.into_tally()
    }
}

/// The calls of a phase.
struct Calls {
    load: Load,
    headers: Request<()>,
    links: Vec<Link>,
    began: Instant,
    tally: Mutex<Tally>,
}

/// A connection, made anew when it is lost.
#[derive(Default)]
struct Link(Mutex<LinkState>);

#[derive(Default)]
struct LinkState {
    client: Option<Client>,
    in_flight: usize,
    /// The calls that wait for a stream, and the times at which they were due.
    waiting: VecDeque<(u64, Instant)>,
}

impl LinkState {
    /// True if a further call would begin at once.
    fn has_room(&self) -> bool {
        let streams = self.client.as_ref().map(Client::current_max_send_streams);
        streams.is_some_and(|streams| self.in_flight < streams)
    }
}

fn lock<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Calls {
    async fn connect(load: Load, length: Duration) -> Arc<Self> {
        let mut headers = wire::headers(load.address, KNN);
        if let Some(deadline) = load.deadline {
            let value = wire::timeout_header(deadline);
            headers.headers_mut().insert("grpc-timeout", value);
        }
        let connect_by = Instant::now() + CONNECT;
        let firsts = (0..load.connections)
            .map(|_| timeout_at(connect_by, wire::open(load.address, LARGE_WINDOW)));
        let firsts = join_all(firsts).await;
        let began = Instant::now() + Duration::from_millis(20);
        let calls = Arc::new(Self {
            headers,
            links: firsts.iter().map(|_| Link::default()).collect(),
            load,
            began,
            tally: Mutex::new(Tally::new(began + length, length)),
        });
        for (i, first) in firsts.into_iter().enumerate() {
            let first = first.ok().and_then(Result::ok);
            tokio::spawn(Arc::clone(&calls).keep_connected(i, first));
        }
        // Meanwhile the servers' settings arrive.
        sleep_until(began).await;
        calls
    }

    /// Drives a connection, and makes it anew when it ends.
    async fn keep_connected(self: Arc<Self>, link: usize, first: Option<Opened>) {
        let mut opened = first;
        loop {
            if let Some((client, connection)) = opened.take() {
                lock(&self.links[link].0).client = Some(client);
                self.resume(link);
                let ended = connection.await;
                lock(&self.links[link].0).client = None;
                lock(&self.tally).record_lost(ended);
            }
            opened = wire::open(self.load.address, LARGE_WINDOW).await.ok();
            if opened.is_none() {
                sleep_until(Instant::now() + RETRY).await;
            }
        }
    }

    /// Begins the calls that waited for a new connection.
    fn resume(self: &Arc<Self>, link: usize) {
        loop {
            let mut state = lock(&self.links[link].0);
            if !state.has_room() {
                return;
            }
            let Some((n, due)) = state.waiting.pop_front() else {
                return;
            };
            state.in_flight += 1;
            tokio::spawn(Arc::clone(self).run(link, n, due));
        }
    }

    /// Begins a call, or lets it wait in the client.
    fn offer(self: &Arc<Self>, n: u64, due: Instant) {
        let link = n as usize % self.links.len();
        let mut tally = lock(&self.tally);
        tally.offered += 1;
        let mut state = lock(&self.links[link].0);
        if state.has_room() {
            state.in_flight += 1;
            tokio::spawn(Arc::clone(self).run(link, n, due));
        } else if state.waiting.len() < QUEUE {
            state.waiting.push_back((n, due));
        } else {
            tally.not_sent += 1;
        }
    }

    /// Makes a call, and then those that wait for its stream.
    async fn run(self: Arc<Self>, link: usize, mut n: u64, mut due: Instant) {
        loop {
            let outcome = self.call(n, due).await;
            lock(&self.tally).record(due, outcome);
            let mut state = lock(&self.links[link].0);
            let waiting = match state.client {
                Some(_) => state.waiting.pop_front(),
                None => None,
            };
            let Some(next) = waiting else {
                state.in_flight -= 1;
                return;
            };
            (n, due) = next;
        }
    }

    /// Makes a call that is due now.
    async fn call_now(&self, n: u64) -> Outcome {
        let due = Instant::now();
        let outcome = self.call(n, due).await;
        let mut tally = lock(&self.tally);
        tally.due += 1;
        tally.offered += 1;
        tally.record(due, outcome);
        outcome
    }

    async fn call(&self, n: u64, due: Instant) -> Outcome {
        let link = &self.links[n as usize % self.links.len()];
        let requests = &self.load.requests;
        let message = requests[n as usize % requests.len()].clone();
        let Some(deadline) = self.load.deadline else {
            return match self.begin(link, self.headers.clone(), message) {
                Ok(response) => wire::outcome(response).await,
                Err(outcome) => outcome,
            };
        };
        let left = deadline.saturating_sub(due.elapsed());
        if left.is_zero() {
            return Outcome::Expired;
        }
        let mut headers = self.headers.clone();
        if deadline - left > Duration::from_millis(5) {
            let value = wire::timeout_header(left);
            headers.headers_mut().insert("grpc-timeout", value);
        }
        // The stream is reset with CANCEL when its handle is dropped, as by stock clients.
        let outcome = match self.begin(link, headers, message) {
            Ok(response) => timeout_at(due + deadline, wire::outcome(response)).await,
            Err(outcome) => Ok(outcome),
        };
        match outcome {
            Ok(outcome) if due.elapsed() <= deadline => outcome,
            _ => Outcome::Expired,
        }
    }

    fn begin(
        &self,
        link: &Link,
        headers: Request<()>,
        message: Bytes,
    ) -> Result<h2::client::ResponseFuture, Outcome> {
        let state = lock(&link.0);
        let client = state.client.as_ref().ok_or(Outcome::Lost)?;
        Ok(wire::begin(client, headers, message)?)
    }

    /// Waits until every call has an outcome, at most until `end`.
    async fn settled(&self, end: Instant) {
        while lock(&self.tally).open() > 0 && Instant::now() < end {
            sleep_until(Instant::now() + Duration::from_millis(10)).await;
        }
    }

    fn into_tally(self: Arc<Self>) -> Tally {
        let mut tally = lock(&self.tally);
        let empty = Tally::new(self.began, Duration::ZERO);
        std::mem::replace(&mut *tally, empty).finish()
    }
}

/// A new connection, not yet driven.
type Opened = (Client, h2::client::Connection<tokio::net::TcpStream>);
