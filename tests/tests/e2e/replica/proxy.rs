//! A connection that can be cut, at any byte, held up, or refused.

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

/// Stands between clients and a server.
pub(super) struct Proxy {
    pub(super) uri: String,
    shared: Arc<Shared>,
}

struct Shared {
    way: watch::Sender<Way>,
    /// After this many more bytes to the clients, all connections are cut, once.
    bytes_left: AtomicI64,
    cuts: watch::Sender<u64>,
}

/// The destination of connections.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Way {
    To(SocketAddr),
    /// To the server, but nothing comes back.
    Held(SocketAddr),
    Closed,
}

fn address(uri: &str) -> SocketAddr {
    uri.strip_prefix("http://").unwrap().parse().unwrap()
}

impl Proxy {
    pub(super) async fn to(uri: &str) -> Proxy {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let shared = Arc::new(Shared {
            way: watch::Sender::new(Way::To(address(uri))),
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

    /// Leads to a server from now on. Connections that are open stay.
    pub(super) fn lead_to(&self, uri: &str) {
        self.shared.way.send_replace(Way::To(address(uri)));
    }

    /// Lets nothing through to the clients.
    pub(super) fn hold(&self, uri: &str) {
        self.shared.way.send_replace(Way::Held(address(uri)));
    }

    /// Cuts all connections, and refuses new ones.
    pub(super) fn close(&self) {
        self.shared.way.send_replace(Way::Closed);
        self.shared.cut();
    }

    /// Cuts all connections after `bytes` more bytes to the clients.
    pub(super) fn cut_after(&self, bytes: i64) {
        self.shared.bytes_left.store(bytes, Ordering::Relaxed);
    }

    /// How often connections were cut.
    pub(super) fn cuts(&self) -> u64 {
        *self.shared.cuts.borrow()
    }
}

impl Shared {
    fn cut(&self) {
        self.cuts.send_modify(|cuts| *cuts += 1);
    }

    async fn carry(self: Arc<Self>, mut client: TcpStream) {
        let mut cuts = self.cuts.subscribe();
        let (Way::To(server) | Way::Held(server)) = *self.way.borrow() else {
            return;
        };
        // A server that is being killed refuses.
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
            let _ = way.wait_for(|way| !matches!(way, Way::Held(_))).await;
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
