//! Accepts a limited number of TCP connections, without Nagle's delay, and can cut each of them, or all at once.

mod read_turns;

use std::{
    io,
    pin::{Pin, pin},
    sync::Arc,
    task::{Context, Poll, ready},
    time::Duration,
};

use futures_util::{Stream, stream};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    net::{TcpListener, TcpStream},
    task::yield_now,
    time::{Instant, Sleep, sleep_until, timeout},
};
use tokio_util::{
    either::Either,
    sync::{CancellationToken, WaitForCancellationFutureOwned},
};
use tonic::transport::server::Connected;
use tracing::{debug, warn};

use read_turns::ReadTurns;

use super::{
    connections::{Activity, Connections, Open},
    tls::{FaceListener, Socket, Tls},
};

/// The pause after a failure of the listener, which fails while the process has no file descriptors left.
const ACCEPT_RETRY_PAUSE: Duration = Duration::from_secs(1);

/// Time in which a finished connection must send what is left in its buffer of TLS.
const FLUSH_TIME: Duration = Duration::from_secs(10);

/// Time that a finished connection waits for its client to close.
const LINGER: Duration = Duration::from_secs(2);

/// Time in which a connection must send the preface of HTTP/2.
const PREFACE_TIME: Duration = Duration::from_secs(10);

/// Bytes of that preface.
const PREFACE_BYTES: usize = 24;

/// The time between two looks for room for unread requests.
const ROOM_PAUSE: Duration = Duration::from_millis(50);

/// Bytes that a connection writes before others have their turn.
const MAX_WRITTEN_BYTES: usize = 64 * 1024;

/// The connections made to `listener`, at most as many at a time as `connections` has room for: a further one waits
/// until an idle one has made room. `cut` fails all of them.
pub(crate) fn incoming(
    listener: FaceListener,
    connections: Arc<Connections>,
    cut: CancellationToken,
) -> impl Stream<Item = io::Result<Connection>> {
    stream::unfold(
        (listener, connections, cut),
        async |(listener, connections, cut)| {
            let (socket, own_cut, open) = loop {
                let socket = accept(&listener.socket, &cut).await;
                // A child token: all connections would contend for the lock of a shared one.
                let own_cut = cut.child_token();
                let open = connections.open(socket.peer_addr().ok(), own_cut.clone());
                if let Some(open) = open.await {
                    break (socket, own_cut, open);
                }
            };
            let client = open.activity().client();
            let read_queue = Arc::clone(connections.read_queue());
            let connection = Connection {
                socket: Tls::accept(listener.tls.as_ref(), socket, client),
                open,
                read_turns: ReadTurns::new(read_queue),
                pause: None,
                written_bytes: 0,
                cut: Box::pin(own_cut.cancelled_owned()),
                preface: Some((
                    PREFACE_BYTES,
                    Box::pin(sleep_until(Instant::now() + PREFACE_TIME)),
                )),
                flushing: None,
                lingering: None,
            };
            Some((Ok(connection), (listener, connections, cut)))
        },
    )
}

async fn accept(listener: &TcpListener, cut: &CancellationToken) -> TcpStream {
    loop {
        match listener.accept().await {
            Ok((socket, peer)) => {
                // Nagle's algorithm would delay small answers by 40 ms.
                if let Err(error) = socket.set_nodelay(true) {
                    debug!(%peer, %error, "cannot set TCP_NODELAY");
                }
                return socket;
            }
            Err(error) if concerns_one_connection(&error) => debug!(%error, "connection lost"),
            Err(error) => {
                warn!(%error, "cannot accept connections; is the limit of open files too low?");
                let _ = timeout(ACCEPT_RETRY_PAUSE, cut.cancelled()).await;
            }
        }
    }
}

/// True if only the connection failed and the listener still works.
fn concerns_one_connection(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::ConnectionAborted
            | io::ErrorKind::ConnectionReset
            | io::ErrorKind::ConnectionRefused
            | io::ErrorKind::Interrupted
            | io::ErrorKind::TimedOut
    )
}

/// One accepted connection.
pub(crate) struct Connection {
    socket: Socket,
    cut: Pin<Box<WaitForCancellationFutureOwned>>,
    read_turns: ReadTurns,
    /// Set while the connection is not read, because there is no room for its unread requests.
    pause: Option<Pin<Box<Sleep>>>,
    /// The bytes that were written since others had their turn.
    written_bytes: usize,
    /// The bytes of the preface that are missing, and the end of the wait for them.
    preface: Option<(usize, Pin<Box<Sleep>>)>,
    /// Set once this side shuts down: the end of the wait for the bytes that are left.
    flushing: Option<Pin<Box<Sleep>>>,
    /// Set once this side has sent everything: the end of the wait for the other.
    lingering: Option<Pin<Box<Sleep>>>,
    open: Open,
}

impl Connection {
    /// Fails once the connection is cut or its preface is late. Every poll begins with it: over TLS, bytes may wait in the
    /// buffer of the socket, and then the server only flushes or shuts down.
    fn check(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        if self.cut.as_mut().poll(context).is_ready() {
            return Err(io::Error::new(
                io::ErrorKind::ConnectionAborted,
                "the server stopped, or needed the place of this idle connection",
            ));
        }
        if let Some((_, end)) = &mut self.preface
            && end.as_mut().poll(context).is_ready()
        {
            return Err(io::Error::new(
                io::ErrorKind::TimedOut,
                "the connection sent no preface of HTTP/2",
            ));
        }
        Ok(())
    }

    /// Sends what is left, and the end of this side.
    fn finish(&mut self, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check(context)?;
        let end = || Box::pin(sleep_until(Instant::now() + FLUSH_TIME));
        let flushing = self.flushing.get_or_insert_with(end);
        if flushing.as_mut().poll(context).is_ready() {
            return Poll::Ready(Err(io::Error::new(
                io::ErrorKind::TimedOut,
                "the client did not read the end of its answers",
            )));
        }
        Pin::new(&mut self.socket).poll_shutdown(context)
    }

    /// Waits while there is no room for the unread requests of this connection.
    fn wait_for_room(&mut self, context: &mut Context<'_>) -> Poll<()> {
        while let Some(pause) = &mut self.pause {
            ready!(pause.as_mut().poll(context));
            let activity = self.open.activity();
            self.pause = match activity.backlog().count() {
                true => None,
                false => {
                    activity.cut_longest_backlog();
                    Some(Box::pin(sleep_until(Instant::now() + ROOM_PAUSE)))
                }
            };
        }
        Poll::Ready(())
    }

    /// Writes, and lets others have their turn after [`MAX_WRITTEN_BYTES`].
    fn write_some(
        &mut self,
        context: &mut Context<'_>,
        write: impl FnOnce(Pin<&mut Socket>, &mut Context<'_>) -> Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        self.check(context)?;
        if self.written_bytes >= MAX_WRITTEN_BYTES {
            self.written_bytes = 0;
            // The task is woken once the runtime has looked for bytes.
            let _ = pin!(yield_now()).poll(context);
            return Poll::Pending;
        }
        let written = write(Pin::new(&mut self.socket), context);
        self.open.activity().set_stalled(written.is_pending());
        match written {
            Poll::Ready(Ok(bytes @ 1..)) => {
                self.open.activity().note_departure(bytes);
                self.written_bytes += bytes;
            }
            _ => self.written_bytes = 0,
        }
        written
    }
}

impl Connected for Connection {
    type ConnectInfo = Activity;

    fn connect_info(&self) -> Activity {
        self.open.activity().clone()
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check(context)?;
        ready!(self.wait_for_room(context));
        let this = &mut *self;
        let flow = this.open.activity().flow();
        ready!(this.read_turns.poll(flow, context));
        let before = buffer.filled().len();
        let read = Pin::new(&mut this.socket).poll_read(context, buffer);
        let came = buffer.filled().len() - before;
        if !this.open.activity().backlog().note_read(came) {
            this.pause = Some(Box::pin(sleep_until(Instant::now())));
        }
        // A socket without TLS fills the buffer if it can.
        let is_drained = matches!(this.socket, Either::Left(_)) && buffer.remaining() > 0;
        this.read_turns
            .note(flow, came, read.is_pending() || is_drained);
        if let Some((missing, _)) = &mut this.preface {
            *missing = missing.saturating_sub(came);
            if *missing == 0 {
                this.preface = None;
            }
        }
        read
    }
}

impl AsyncWrite for Connection {
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

    fn is_write_vectored(&self) -> bool {
        self.socket.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check(context)?;
        Pin::new(&mut self.socket).poll_flush(context)
    }

    /// Shuts down this side and waits for the client's. A socket that closes while its client still sends (a window
    /// update suffices) is reset, and its client loses the answers that it has not read.
    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let this = &mut *self;
        if this.lingering.is_none() {
            ready!(this.finish(context))?;
        }
        let end = || Box::pin(sleep_until(Instant::now() + LINGER));
        let lingering = this.lingering.get_or_insert_with(end);
        if lingering.as_mut().poll(context).is_ready() || this.cut.as_mut().poll(context).is_ready()
        {
            return Poll::Ready(Ok(()));
        }
        let mut scratch = [0; 1024];
        loop {
            let mut unwanted = ReadBuf::new(&mut scratch);
            let read = ready!(Pin::new(&mut this.socket).poll_read(context, &mut unwanted));
            if read.is_err() || unwanted.filled().is_empty() {
                return Poll::Ready(Ok(()));
            }
        }
    }
}

#[cfg(test)]
mod tests;
