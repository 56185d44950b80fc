//! Accepts a limited number of TCP connections, without Nagle's delay, and can cut each of them, or all at once.

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
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::transport::server::Connected;
use tracing::{debug, warn};

use super::{
    connections::{Activity, Connections, Open},
    tls::{Socket, Tls},
};

/// The pause after a failure of the listener, which fails while the process has no file descriptors left.
const ACCEPT_RETRY_PAUSE: Duration = Duration::from_secs(1);

/// Time that a finished connection waits for its client to close.
const LINGER: Duration = Duration::from_secs(2);

/// Time in which a connection must send the preface of HTTP/2.
const PREFACE_TIME: Duration = Duration::from_secs(10);

/// Bytes of that preface.
const PREFACE_BYTES: usize = 24;

/// A connection that reads on after a shorter pause keeps up with its client, whatever that sends.
const SHORT_PAUSE: Duration = Duration::from_millis(1);

/// Bytes after which a connection lets others have their turn: about fifty small calls. HTTP/2 asks for more after each call
/// that it hands on, so one poll of its task may read several times as many.
const MAX_READ_BYTES: usize = 8 * 1024;

/// The same while no call comes with them. Requests as large take their own time to come: they do not wait.
const MAX_BODY_BYTES: usize = 64 * 1024;

/// Bytes that a connection writes before others have their turn.
const MAX_WRITTEN_BYTES: usize = 64 * 1024;

/// The connections made to `listener`, at most as many at a time as `connections` has room for: a further one waits
/// until an idle one has made room. `cut` fails all of them.
pub(crate) fn incoming(
    listener: TcpListener,
    connections: Arc<Connections>,
    tls: Option<Tls>,
    cut: CancellationToken,
) -> impl Stream<Item = io::Result<Connection>> {
    stream::unfold(
        (listener, connections, tls, cut),
        async |(listener, connections, tls, cut)| {
            let socket = accept(&listener, &cut).await;
            // A child token: all connections would contend for the lock of a shared one.
            let own_cut = cut.child_token();
            let open = connections.open(socket.peer_addr().ok(), own_cut.clone());
            let open = open.await;
            let connection = Connection {
                socket: Tls::accept(tls.as_ref(), socket, Some(open.activity().client())),
                open,
                read_bytes: 0,
                read_calls: 0,
                written_bytes: 0,
                was_silent: true,
                paused: None,
                cut: Box::pin(own_cut.cancelled_owned()),
                preface: Some((
                    PREFACE_BYTES,
                    Box::pin(sleep_until(Instant::now() + PREFACE_TIME)),
                )),
                lingering: None,
            };
            Some((Ok(connection), (listener, connections, tls, cut)))
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
    /// The bytes that were read since others had their turn.
    read_bytes: usize,
    /// The calls of the flow at the last turn of others.
    read_calls: u64,
    /// The bytes that were written since others had their turn.
    written_bytes: usize,
    /// True if there was nothing to read.
    was_silent: bool,
    /// The time since which others have their turn.
    paused: Option<Instant>,
    /// The bytes of the preface that are missing, and the end of the wait for them.
    preface: Option<(usize, Pin<Box<Sleep>>)>,
    /// Set once this side has sent everything: the end of the wait for the other.
    lingering: Option<Pin<Box<Sleep>>>,
    open: Open,
}

impl Connection {
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
}

impl Connection {
    /// Writes, and lets others have their turn after [`MAX_WRITTEN_BYTES`].
    fn write_some(
        &mut self,
        context: &mut Context<'_>,
        write: impl FnOnce(Pin<&mut Socket>, &mut Context<'_>) -> Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        // A client that no longer reads keeps a connection here.
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
                self.open.activity().note_departure();
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
        let calls = self.open.activity().flow().calls();
        let has_calls = calls != self.read_calls;
        if self.read_bytes >= MAX_BODY_BYTES && !has_calls {
            self.open.activity().flow().catch_up();
        }
        if self.read_bytes >= MAX_BODY_BYTES || self.read_bytes >= MAX_READ_BYTES && has_calls {
            self.read_bytes = 0;
            self.read_calls = calls;
            self.paused = Some(Instant::now());
            context.waker().wake_by_ref();
            return Poll::Pending;
        }
        let paused = self.paused.take();
        if paused.is_some_and(|since| since.elapsed() < SHORT_PAUSE) {
            self.open.activity().flow().catch_up();
        }
        let before = buffer.filled().len();
        let read = Pin::new(&mut self.socket).poll_read(context, buffer);
        let came = buffer.filled().len() - before;
        // Bytes after a silence have just arrived.
        if read.is_pending() || self.was_silent {
            self.open.activity().flow().catch_up();
        }
        self.was_silent = read.is_pending();
        self.read_bytes = match self.was_silent {
            true => 0,
            false => self.read_bytes + came,
        };
        if let Some((missing, _)) = &mut self.preface {
            *missing = missing.saturating_sub(came);
            if *missing == 0 {
                self.preface = None;
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
        Pin::new(&mut self.socket).poll_flush(context)
    }

    /// Shuts down this side and waits for the client's. A socket that closes while its client still sends (a window
    /// update suffices) is reset, and its client loses the answers that it has not read.
    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let this = &mut *self;
        let lingering = match &mut this.lingering {
            Some(lingering) => lingering,
            none => {
                ready!(Pin::new(&mut this.socket).poll_shutdown(context))?;
                none.insert(Box::pin(sleep_until(Instant::now() + LINGER)))
            }
        };
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
mod tests {
    use std::pin::pin;

    use futures_util::{StreamExt, poll};
    use tokio::{
        io::{AsyncReadExt, AsyncWriteExt},
        time::advance,
    };

    use super::*;
    use crate::{admission::Admission, config::Config};

    /// A connection to a listener of its own, and its peer, which has sent some bytes.
    async fn connection(sent: &[u8]) -> (Connection, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut peer = TcpStream::connect(address).await.unwrap();
        peer.write_all(sent).await.unwrap();
        let mut incoming = Box::pin(incoming(
            listener,
            Connections::new(1, 1, Admission::new(&Config::default().admission, 1, 0)),
            None,
            CancellationToken::new(),
        ));
        let connection = incoming.next().await.unwrap().unwrap();
        (connection, peer)
    }

    #[tokio::test(start_paused = true)]
    async fn a_connection_without_a_preface_is_closed() {
        for sent in [&b""[..], b"PRI * HTTP/2.0"] {
            let (mut connection, _peer) = connection(sent).await;
            let mut received = Vec::new();
            let error = connection.read_to_end(&mut received).await.unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::TimedOut);
            assert_eq!(received, sent);
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_connection_with_a_preface_may_be_silent() {
        let (mut connection, _peer) = connection(&[0; PREFACE_BYTES]).await;
        let mut received = [0; PREFACE_BYTES];
        connection.read_exact(&mut received).await.unwrap();
        let silence = timeout(100 * PREFACE_TIME, connection.read(&mut received));
        assert!(silence.await.is_err());
    }

    #[tokio::test(start_paused = true)]
    async fn a_client_that_reads_its_answer_slowly_gives_signs_of_life() {
        const STEP: Duration = Duration::from_secs(1);
        let (mut connection, mut peer) = connection(&[0; PREFACE_BYTES]).await;
        connection
            .read_exact(&mut [0; PREFACE_BYTES])
            .await
            .unwrap();
        let activity = connection.open.activity().clone();
        // Without an answer, bytes that leave are those of HTTP/2 itself.
        let opened = activity.silence();
        advance(STEP).await;
        connection.write_all(b"ping").await.unwrap();
        assert_eq!(activity.silence(), opened + STEP);
        let _answer = activity.send();
        connection.write_all(b"a part").await.unwrap();
        assert_eq!(activity.silence(), Duration::ZERO);
        // The client reads nothing: the rest of the answer waits.
        let part = vec![0; 1024 * 1024];
        let mut left = b"ping".len() + b"a part".len();
        // One pending write lets others have their turn; after a second, the socket has no room.
        let mut pending = 0;
        while pending < 2 {
            match poll!(pin!(connection.write(&part))) {
                Poll::Ready(written) => (left, pending) = (left + written.unwrap(), 0),
                Poll::Pending => pending += 1,
            }
        }
        advance(STEP).await;
        assert!(poll!(pin!(connection.write(&part))).is_pending());
        assert_eq!(activity.silence(), STEP);
        // It reads again.
        peer.read_exact(&mut vec![0; left]).await.unwrap();
        connection.write_all(&part[..1]).await.unwrap();
        assert_eq!(activity.silence(), Duration::ZERO);
    }
}
