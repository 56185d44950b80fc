//! A proxy that can cut connections at any byte, delay them, or refuse them.

use std::{
    net::SocketAddr,
    sync::{
        Arc,
        atomic::{AtomicI64, Ordering},
    },
};

use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::{TcpListener, TcpStream},
    sync::watch,
};

/// A proxy between clients and a server.
pub(crate) struct Proxy {
    pub(crate) uri: String,
    shared: Arc<ProxyState>,
}

struct ProxyState {
    way: watch::Sender<Route>,
    /// The number of further bytes to the clients after which all connections are cut once.
    bytes_left: AtomicI64,
    cuts: watch::Sender<u64>,
}

/// The destination of connections.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Route {
    To(SocketAddr),
    /// To the server, without any answer back.
    Held(SocketAddr),
    Closed,
}

fn address(uri: &str) -> SocketAddr {
    uri.strip_prefix("http://").unwrap().parse().unwrap()
}

impl Proxy {
    pub(crate) async fn to(uri: &str) -> Proxy {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let shared = Arc::new(ProxyState {
            way: watch::Sender::new(Route::To(address(uri))),
            bytes_left: AtomicI64::new(i64::MAX),
            cuts: watch::Sender::new(0),
        });
        let uri = format!("http://{}", listener.local_addr().unwrap());
        let connections = Arc::clone(&shared);
        tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                tokio::spawn(Arc::clone(&connections).carry(client));
            }
        });
        Proxy { uri, shared }
    }

    /// Forwards new connections to a server. Open connections stay.
    pub(crate) fn lead_to(&self, uri: &str) {
        self.shared.way.send_replace(Route::To(address(uri)));
    }

    /// Stops all data to the clients.
    pub(crate) fn hold(&self, uri: &str) {
        self.shared.way.send_replace(Route::Held(address(uri)));
    }

    /// Cuts all connections, and refuses new ones.
    pub(crate) fn close(&self) {
        self.shared.way.send_replace(Route::Closed);
        self.shared.cut();
    }

    /// Cuts all connections after `bytes` more bytes to the clients.
    pub(crate) fn cut_after(&self, bytes: i64) {
        self.shared.bytes_left.store(bytes, Ordering::Relaxed);
    }

    /// The number of times that connections were cut.
    pub(crate) fn cuts(&self) -> u64 {
        *self.shared.cuts.borrow()
    }
}

impl ProxyState {
    fn cut(&self) {
        self.cuts.send_modify(|cuts| *cuts += 1);
    }

    async fn carry(self: Arc<Self>, mut client: TcpStream) {
        let mut cuts = self.cuts.subscribe();
        let (Route::To(server) | Route::Held(server)) = *self.way.borrow() else {
            return;
        };
        // A server that is being killed refuses the connection.
        let Ok(mut server) = TcpStream::connect(server).await else {
            return;
        };
        server.set_nodelay(true).unwrap();
        client.set_nodelay(true).unwrap();
        let (mut from_client, mut to_client) = client.split();
        let (mut from_server, mut to_server) = server.split();
        tokio::select! {
            _ = tokio::io::copy(&mut from_client, &mut to_server) => {}
            () = self.carry_back(&mut from_server, &mut to_client) => {}
            _ = cuts.changed() => {}
        }
    }

    async fn carry_back(
        &self,
        from_server: &mut (impl AsyncReadExt + Unpin),
        to_client: &mut (impl AsyncWriteExt + Unpin),
    ) {
        let mut way = self.way.subscribe();
        let mut bytes = vec![0; 16 * 1024];
        while let Ok(read @ 1..) = from_server.read(&mut bytes).await {
            let _ = way.wait_for(|way| !matches!(way, Route::Held(_))).await;
            let count = i64::try_from(read).unwrap();
            let left = self.bytes_left.fetch_sub(count, Ordering::Relaxed);
            if left < count {
                self.bytes_left.store(i64::MAX, Ordering::Relaxed);
                // The remaining bytes go through, and the stream ends in the middle of a frame.
                let passes = usize::try_from(left).unwrap_or(0);
                let _ = to_client.write_all(&bytes[..passes]).await;
                return self.cut();
            }
            if to_client.write_all(&bytes[..read]).await.is_err() {
                return;
            }
        }
    }
}
