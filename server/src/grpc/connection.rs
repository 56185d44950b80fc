//! Accepts TCP connections: not more than allowed, without Nagle's delay, and so that all of them can be cut at once.
//!
//! Answers that are ready at the same time, as those that waited for one sync, leave in one write: with many tasks on
//! few connections, each write costs the server more than all the rest of a call.

use std::{
    io,
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
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
use tonic::transport::server::Connected;
use tracing::{debug, warn};

/// How long to leave the listener alone after it failed, as it does while the process has no file descriptors left.
const PAUSE_AFTER_FAILURE: Duration = Duration::from_secs(1);

/// From so many calls under way on, a connection looks after the others before it writes.
const MANY: usize = 4;

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
            under_way: UnderWay::default(),
            gathering: false,
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
    under_way: UnderWay,
    /// What is to be written has waited once already.
    gathering: bool,
    _slot: OwnedSemaphorePermit,
}

/// How many calls of a connection are under way: all that hold one of these.
#[derive(Clone, Debug, Default)]
pub(crate) struct UnderWay(Arc<AtomicUsize>);

/// One call that is under way until this is dropped.
#[derive(Debug)]
pub(crate) struct OneMore(Arc<AtomicUsize>);

impl UnderWay {
    /// Counts a call.
    pub(crate) fn begin(&self) -> OneMore {
        self.0.fetch_add(1, Ordering::Relaxed);
        OneMore(Arc::clone(&self.0))
    }

    fn count(&self) -> usize {
        self.0.load(Ordering::Relaxed)
    }
}

impl Drop for OneMore {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Connection {
    /// Puts what is to be written off once, behind all tasks that are ready to run: they may have more.
    fn gather(&mut self, context: &mut Context<'_>) -> Poll<()> {
        if self.gathering || self.under_way.count() < MANY {
            self.gathering = false;
            return Poll::Ready(());
        }
        self.gathering = true;
        context.waker().wake_by_ref();
        Poll::Pending
    }

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
    type ConnectInfo = UnderWay;

    fn connect_info(&self) -> UnderWay {
        self.under_way.clone()
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
        ready!(self.gather(context));
        Pin::new(&mut self.socket).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.check(context)?;
        ready!(self.gather(context));
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

#[cfg(test)]
mod tests {
    use std::{future::poll_fn, pin::pin};

    use futures_util::StreamExt;
    use tokio::io::AsyncReadExt;

    use super::*;

    /// How often the task of a write runs in which so many calls are under way.
    async fn runs(calls: usize) -> usize {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let mut client = TcpStream::connect(listener.local_addr().unwrap())
            .await
            .unwrap();
        let mut accepted = pin!(incoming(listener, 1, CancellationToken::new()));
        let mut connection = accepted.next().await.unwrap().unwrap();
        let calls: Vec<_> = (0..calls)
            .map(|_| connection.connect_info().begin())
            .collect();
        let mut runs = 0;
        let written = poll_fn(|context| {
            runs += 1;
            Pin::new(&mut connection).poll_write(context, b"answers")
        });
        assert_eq!(written.await.unwrap(), 7);
        let mut read = [0; 7];
        client.read_exact(&mut read).await.unwrap();
        assert_eq!(&read, b"answers");
        drop(calls);
        assert_eq!(connection.under_way.count(), 0);
        runs
    }

    #[tokio::test]
    async fn an_answer_waits_once_for_others_where_there_may_be_many() {
        assert_eq!(runs(MANY - 1).await, 1);
        assert_eq!(runs(MANY).await, 2);
    }
}
