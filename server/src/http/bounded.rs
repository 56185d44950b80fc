//! A connection to the pages for operators. It ends after a time in which it took nothing, so that a silent one gives up its
//! place.

use std::{
    io,
    pin::Pin,
    task::{Context, Poll},
    time::Duration,
};

use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    sync::OwnedSemaphorePermit,
    time::{Instant, Sleep, sleep_until},
};

use crate::grpc::Socket;

/// The time in which a connection takes some bytes of an answer. Clients of HTTP connect again by themselves.
const MAX_STALL: Duration = Duration::from_secs(60);

/// See the module.
pub(super) struct Bounded {
    socket: Socket,
    end: Pin<Box<Sleep>>,
    _place: OwnedSemaphorePermit,
}

impl Bounded {
    pub(super) fn new(socket: Socket, place: OwnedSemaphorePermit) -> Self {
        Self {
            socket,
            end: Box::pin(sleep_until(Instant::now() + MAX_STALL)),
            _place: place,
        }
    }

    fn check(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        match self.end.as_mut().poll(context) {
            Poll::Ready(()) => Err(io::ErrorKind::TimedOut.into()),
            Poll::Pending => Ok(()),
        }
    }
}

impl AsyncRead for Bounded {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check(context)?;
        Pin::new(&mut self.socket).poll_read(context, buffer)
    }
}

impl AsyncWrite for Bounded {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.check(context)?;
        let written = Pin::new(&mut self.socket).poll_write(context, bytes);
        if matches!(written, Poll::Ready(Ok(1..))) {
            self.end.as_mut().reset(Instant::now() + MAX_STALL);
        }
        written
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use tokio::{
        io::{AsyncReadExt, AsyncWriteExt},
        net::{TcpListener, TcpStream},
        sync::Semaphore,
    };

    use super::*;
    use crate::grpc::Tls;

    #[tokio::test(start_paused = true)]
    async fn a_silent_connection_gives_its_place_up_after_its_time() {
        let places = Arc::new(Semaphore::new(1));
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut client = TcpStream::connect(address).await.unwrap();
        let (socket, _) = listener.accept().await.unwrap();
        let place = Arc::clone(&places).acquire_owned().await.unwrap();
        let mut bounded = Bounded::new(Tls::accept(None, socket, None), place);
        client.write_all(b"G").await.unwrap();
        assert_eq!(bounded.read_u8().await.unwrap(), b'G');
        let began = Instant::now();
        let ended = bounded.read_u8().await.unwrap_err();
        assert_eq!(ended.kind(), io::ErrorKind::TimedOut);
        assert!(began.elapsed() >= MAX_STALL);
        assert_eq!(places.available_permits(), 0);
        drop(bounded);
        assert_eq!(places.available_permits(), 1);
    }
    #[tokio::test(start_paused = true)]
    async fn a_connection_that_takes_answers_goes_on() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let _client = TcpStream::connect(address).await.unwrap();
        let (socket, _) = listener.accept().await.unwrap();
        let place = Arc::new(Semaphore::new(1)).acquire_owned().await.unwrap();
        let mut bounded = Bounded::new(Tls::accept(None, socket, None), place);
        for _ in 0..4 {
            tokio::time::advance(MAX_STALL / 2).await;
            bounded.write_all(b"more").await.unwrap();
        }
        tokio::time::advance(MAX_STALL).await;
        let ended = bounded.write_all(b"more").await.unwrap_err();
        assert_eq!(ended.kind(), io::ErrorKind::TimedOut);
    }
}
