//! The connections to the pages for operators, which are few. One ends after a time in which it took nothing. Once all slots
//! are taken, one without a call makes room for the next: strangers keep no probe out, and end no stream.

use std::{
    collections::BTreeMap,
    io,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use parking_lot::Mutex;
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    sync::{OwnedSemaphorePermit, Semaphore},
    time::{Instant, Sleep, sleep_until, timeout},
};
use tokio_util::{
    sync::{CancellationToken, WaitForCancellationFutureOwned},
    task::TaskTracker,
};

use crate::grpc::Socket;

/// The time in which a connection takes some bytes of an answer. Clients of HTTP connect again by themselves.
const MAX_STALL: Duration = Duration::from_secs(60);

/// A connection keeps its slot for this long after it was opened and after it took bytes: its request may be on its way.
/// Probes wait a second for an answer.
const MIN_SILENCE: Duration = Duration::from_millis(250);

/// The slots of a listener.
pub(super) struct ConnectionSlots {
    free: Arc<Semaphore>,
    /// The connections by the order in which they were opened.
    open: Mutex<BTreeMap<u64, OpenConnection>>,
}

struct OpenConnection {
    opened_at: Instant,
    active_at: Instant,
    /// The admitted calls.
    calls: TaskTracker,
    cut: CancellationToken,
}

/// A slot, until it is dropped.
pub(super) struct ConnectionSlot {
    slots: Arc<ConnectionSlots>,
    number: u64,
    cut: CancellationToken,
    /// The admitted calls of its connection take tokens of it.
    pub(super) calls: TaskTracker,
    _permit: OwnedSemaphorePermit,
}

impl ConnectionSlots {
    pub(super) fn new(limit: usize) -> Arc<Self> {
        Arc::new(Self {
            free: Arc::new(Semaphore::new(limit)),
            open: Mutex::default(),
        })
    }

    /// Waits for a slot, which another connection gives up if there is no other.
    pub(super) async fn take(self: &Arc<Self>) -> ConnectionSlot {
        let permit = loop {
            if let Ok(permit) = Arc::clone(&self.free).try_acquire_owned() {
                break permit;
            }
            self.give_one_up();
            let free = Arc::clone(&self.free).acquire_owned();
            if let Ok(Ok(permit)) = timeout(MIN_SILENCE, free).await {
                break permit;
            }
        };
        let cut = CancellationToken::new();
        let calls = TaskTracker::new();
        let mut open = self.open.lock();
        let number = open.last_key_value().map_or(0, |(last, _)| last + 1);
        let connection = OpenConnection {
            opened_at: Instant::now(),
            active_at: Instant::now(),
            calls: calls.clone(),
            cut: cut.clone(),
        };
        open.insert(number, connection);
        drop(open);
        ConnectionSlot {
            slots: Arc::clone(self),
            number,
            cut,
            calls,
            _permit: permit,
        }
    }

    /// Cuts the connection without a call that was silent for the longest time, or the first one if none is silent; if all
    /// have calls, the one that was silent for the longest time.
    fn give_one_up(&self) {
        let open = self.open.lock();
        // A connection that is cut may take a while to end, and is not cut again.
        let open = || open.values().filter(|it| !it.cut.is_cancelled());
        let without_call = || open().filter(|it| it.calls.is_empty());
        let is_silent = |it: &&OpenConnection| it.active_at.elapsed() >= MIN_SILENCE;
        let least = without_call()
            .min_by_key(|it| it.active_at)
            .filter(is_silent);
        // A stranger that asks for one probe after another is never silent.
        let first = || without_call().find(|it| it.opened_at.elapsed() >= MIN_SILENCE);
        let with_call = || open().min_by_key(|it| it.active_at).filter(is_silent);
        if let Some(connection) = least.or_else(first).or_else(with_call) {
            connection.cut.cancel();
        }
    }
}

impl ConnectionSlot {
    fn note_activity(&self) {
        if let Some(connection) = self.slots.open.lock().get_mut(&self.number) {
            connection.active_at = Instant::now();
        }
    }
}

impl Drop for ConnectionSlot {
    fn drop(&mut self) {
        self.slots.open.lock().remove(&self.number);
    }
}

/// A connection with its slot.
pub(super) struct BoundedConnection {
    socket: Socket,
    end: Pin<Box<Sleep>>,
    cut: Pin<Box<WaitForCancellationFutureOwned>>,
    slot: ConnectionSlot,
}

impl BoundedConnection {
    pub(super) fn new(socket: Socket, slot: ConnectionSlot) -> Self {
        Self {
            socket,
            end: Box::pin(sleep_until(Instant::now() + MAX_STALL)),
            cut: Box::pin(slot.cut.clone().cancelled_owned()),
            slot,
        }
    }

    /// Fails once the connection is cut or its time is over. Every poll begins with it: over TLS, bytes may wait in the
    /// buffer of the socket, and then the server only flushes or shuts down.
    fn check(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        if self.cut.as_mut().poll(context).is_ready() {
            return Err(io::ErrorKind::ConnectionAborted.into());
        }
        match self.end.as_mut().poll(context) {
            Poll::Ready(()) => Err(io::ErrorKind::TimedOut.into()),
            Poll::Pending => Ok(()),
        }
    }

    /// Writes, and notes whether the client took bytes.
    fn write_some(
        &mut self,
        context: &mut Context<'_>,
        write: impl FnOnce(Pin<&mut Socket>, &mut Context<'_>) -> Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        self.check(context)?;
        let written = write(Pin::new(&mut self.socket), context);
        if matches!(written, Poll::Ready(Ok(1..))) {
            self.end.as_mut().reset(Instant::now() + MAX_STALL);
            self.slot.note_activity();
        }
        written
    }
}

impl AsyncRead for BoundedConnection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check(context)?;
        Pin::new(&mut self.socket).poll_read(context, buffer)
    }
}

impl AsyncWrite for BoundedConnection {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.write_some(context, |socket, context| socket.poll_write(context, bytes))
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.write_some(context, |socket, context| {
            socket.poll_write_vectored(context, slices)
        })
    }

    /// Without it, hyper would copy answers into a buffer that nothing counts.
    fn is_write_vectored(&self) -> bool {
        self.socket.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check(context)?;
        Pin::new(&mut self.socket).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check(context)?;
        Pin::new(&mut self.socket).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use std::pin::pin;

    use futures_util::{future::join, poll};
    use tokio::{
        io::{AsyncReadExt, AsyncWriteExt},
        net::{TcpListener, TcpStream},
        spawn,
        time::{advance, pause},
    };
    use tokio_rustls::client::TlsStream;

    use super::*;
    use crate::grpc::{Tls, tls_testing};

    /// A connection that takes a slot, and its client.
    async fn connect(
        listener: &TcpListener,
        slots: &Arc<ConnectionSlots>,
    ) -> (TcpStream, BoundedConnection) {
        let address = listener.local_addr().unwrap();
        let client = TcpStream::connect(address).await.unwrap();
        let slot = slots.take().await;
        let (socket, _) = listener.accept().await.unwrap();
        (
            client,
            BoundedConnection::new(Tls::accept(None, socket, None), slot),
        )
    }

    async fn listen() -> TcpListener {
        TcpListener::bind("127.0.0.1:0").await.unwrap()
    }

    #[tokio::test(start_paused = true)]
    async fn a_silent_connection_gives_its_slot_up_after_its_time() {
        let slots = ConnectionSlots::new(1);
        let (mut client, mut bounded) = connect(&listen().await, &slots).await;
        client.write_all(b"G").await.unwrap();
        assert_eq!(bounded.read_u8().await.unwrap(), b'G');
        let began = Instant::now();
        let ended = bounded.read_u8().await.unwrap_err();
        assert_eq!(ended.kind(), io::ErrorKind::TimedOut);
        assert!(began.elapsed() >= MAX_STALL);
        assert_eq!(slots.free.available_permits(), 0);
        drop(bounded);
        assert_eq!(slots.free.available_permits(), 1);
    }

    #[tokio::test(start_paused = true)]
    async fn a_connection_that_takes_answers_goes_on() {
        let (_client, mut bounded) = connect(&listen().await, &ConnectionSlots::new(1)).await;
        for _ in 0..4 {
            advance(MAX_STALL / 2).await;
            bounded.write_all(b"more").await.unwrap();
        }
        advance(MAX_STALL).await;
        let ended = bounded.write_all(b"more").await.unwrap_err();
        assert_eq!(ended.kind(), io::ErrorKind::TimedOut);
    }

    #[tokio::test(start_paused = true)]
    async fn the_longest_silence_makes_room() {
        let (listener, slots) = (listen().await, ConnectionSlots::new(2));
        let (_live, mut live) = connect(&listener, &slots).await;
        let (_silent, mut silent) = connect(&listener, &slots).await;
        advance(MIN_SILENCE).await;
        live.write_all(b"an answer").await.unwrap();
        // A connection that is cut ends at its next poll, and frees its slot.
        let ended = tokio::spawn(async move { silent.read_u8().await.unwrap_err().kind() });
        let began = Instant::now();
        let _third = connect(&listener, &slots).await;
        assert!(began.elapsed() < MAX_STALL);
        assert_eq!(ended.await.unwrap(), io::ErrorKind::ConnectionAborted);
        live.write_all(b"another").await.unwrap();
    }

    /// The end of a connection that writes again and again before it counts as silent.
    async fn keep_active(mut bounded: BoundedConnection) -> io::ErrorKind {
        loop {
            if let Err(error) = bounded.write_all(b"alive").await {
                return error.kind();
            }
            // The clock is paused.
            sleep_until(Instant::now() + MIN_SILENCE / 2).await;
        }
    }

    #[tokio::test(start_paused = true)]
    async fn the_first_connection_without_a_call_makes_room_if_none_is_silent() {
        let (listener, slots) = (listen().await, ConnectionSlots::new(3));
        let mut clients = Vec::new();
        let mut open = Vec::new();
        for _ in 0..3 {
            let (client, bounded) = connect(&listener, &slots).await;
            clients.push(client);
            open.push(bounded);
        }
        let _call = open[0].slot.calls.token();
        let open: Vec<_> = open.into_iter().map(|it| spawn(keep_active(it))).collect();
        let taken = timeout(10 * MIN_SILENCE, slots.take()).await;
        assert!(taken.is_ok(), "no slot");
        let is_ended: Vec<bool> = open.iter().map(|it| it.is_finished()).collect();
        assert_eq!(is_ended, [false, true, false]);
    }

    #[tokio::test(start_paused = true)]
    async fn a_cut_connection_that_does_not_end_is_not_the_only_one_cut() {
        let slots = ConnectionSlots::new(2);
        let held = [slots.take().await, slots.take().await];
        assert!(timeout(10 * MIN_SILENCE, slots.take()).await.is_err());
        assert!(held.iter().all(|slot| slot.cut.is_cancelled()));
    }

    /// A connection over TLS that has written more than its socket takes, and its client, which reads nothing.
    async fn unread_connection() -> (BoundedConnection, TlsStream<TcpStream>) {
        let (tls, connector) = tls_testing::pair();
        let listener = listen().await;
        let client = TcpStream::connect(listener.local_addr().unwrap()).await;
        let (socket, _) = listener.accept().await.unwrap();
        let socket = Tls::accept(Some(&tls), socket, None);
        let mut bounded = BoundedConnection::new(socket, ConnectionSlots::new(1).take().await);
        let opening = async {
            let mut client = tls_testing::connect(&connector, client.unwrap()).await;
            client.write_all(b"G").await.unwrap();
            client
        };
        let (client, read) = join(opening, bounded.read_u8()).await;
        assert_eq!(read.unwrap(), b'G');
        tls_testing::fill(&mut bounded).await;
        (bounded, client)
    }

    async fn assert_ends(bounded: &mut BoundedConnection, kind: io::ErrorKind) {
        for ended in [
            poll!(pin!(bounded.flush())),
            poll!(pin!(bounded.shutdown())),
        ] {
            let Poll::Ready(Err(error)) = ended else {
                panic!("{ended:?}");
            };
            assert_eq!(error.kind(), kind);
        }
    }

    #[tokio::test]
    async fn a_cut_ends_a_connection_that_waits_for_its_client_to_read() {
        let (mut bounded, _client) = unread_connection().await;
        assert!(poll!(pin!(bounded.flush())).is_pending());
        bounded.slot.cut.cancel();
        assert_ends(&mut bounded, io::ErrorKind::ConnectionAborted).await;
    }

    #[tokio::test]
    async fn a_connection_ends_after_its_time_while_its_client_reads_nothing() {
        let (mut bounded, _client) = unread_connection().await;
        pause();
        advance(MAX_STALL).await;
        assert_ends(&mut bounded, io::ErrorKind::TimedOut).await;
    }
}
