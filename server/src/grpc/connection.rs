//! Accepts TCP connections: not more than allowed, without Nagle's delay, and so that all of them can be cut at once.

use std::{
    io,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll, ready},
    time::Duration,
};

use futures_util::{Stream, stream};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    net::{TcpListener, TcpStream},
    sync::{OwnedSemaphorePermit, Semaphore},
    time::{Instant, Sleep, sleep_until, timeout},
};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::transport::server::{Connected, TcpConnectInfo};
use tracing::{debug, warn};

/// How long to leave the listener alone after it failed, as it does while the process has no file descriptors left.
const PAUSE_AFTER_FAILURE: Duration = Duration::from_secs(1);

/// How long a connection that is done waits for its client to hang up.
const LINGER: Duration = Duration::from_secs(2);

/// The connections made to `listener`, of which at most `limit` are open at a time: further ones wait in the
/// listener's queue. `cut` fails every one of them, whatever it is doing.
pub(crate) fn incoming(
    listener: TcpListener,
    limit: usize,
    cut: CancellationToken,
) -> impl Stream<Item = io::Result<Connection>> {
    let slots = Arc::new(Semaphore::new(limit.min(Semaphore::MAX_PERMITS)));
    stream::unfold((listener, slots, cut), async |(listener, slots, cut)| {
        let slot = slots.clone().acquire_owned().await.ok()?;
        let socket = accept(&listener, &cut).await;
        let connection = Connection {
            socket,
            // A token of its own: waiting on the shared one would have all connections contend for its lock.
            cut: Box::pin(cut.child_token().cancelled_owned()),
            lingering: None,
            _slot: slot,
        };
        Some((Ok(connection), (listener, slots, cut)))
    })
}

async fn accept(listener: &TcpListener, cut: &CancellationToken) -> TcpStream {
    loop {
        match listener.accept().await {
            Ok((socket, peer)) => {
                // Delayed by Nagle's algorithm, small answers take 40 ms.
                if let Err(error) = socket.set_nodelay(true) {
                    debug!(%peer, %error, "cannot set TCP_NODELAY");
                }
                return socket;
            }
            Err(error) if concerns_one_connection(&error) => debug!(%error, "connection lost"),
            Err(error) => {
                warn!(%error, "cannot accept connections; is the limit of open files too low?");
                let _ = timeout(PAUSE_AFTER_FAILURE, cut.cancelled()).await;
            }
        }
    }
}

/// Whether the listener itself is well and only the connection it was about to hand over is not.
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
#[derive(Debug)]
pub(crate) struct Connection {
    socket: TcpStream,
    cut: Pin<Box<WaitForCancellationFutureOwned>>,
    /// Set once this side has sent all that it will: when to stop waiting for the other.
    lingering: Option<Pin<Box<Sleep>>>,
    _slot: OwnedSemaphorePermit,
}

impl Connection {
    fn check(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        if self.cut.as_mut().poll(context).is_ready() {
            return Err(io::Error::new(
                io::ErrorKind::ConnectionAborted,
                "the server stopped before this connection was done",
            ));
        }
        Ok(())
    }
}

impl Connected for Connection {
    type ConnectInfo = TcpConnectInfo;

    fn connect_info(&self) -> TcpConnectInfo {
        self.socket.connect_info()
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check(context)?;
        Pin::new(&mut self.socket).poll_read(context, buffer)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        // A client that reads no more keeps a connection in here.
        self.check(context)?;
        Pin::new(&mut self.socket).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.check(context)?;
        Pin::new(&mut self.socket).poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.socket.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_flush(context)
    }

    /// Says goodbye and waits for the client to do the same. A socket that is closed while its client still sends
    /// (a window update is enough) is reset, and with it go the last answers, if they are not read by then.
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
