//! A real server, on a thread and a port of its own.

use std::net::TcpListener;

use tokio::sync::oneshot;
use wayfold::{Client, IndexHandle};
use wayfold_server::config::{Config, DataConfig, OFF, ZenohConfig};

/// Stops when it is dropped. The drop does not wait for the stop: the connections to close may belong to its thread.
pub(crate) struct Server {
    pub(crate) uri: String,
    _stop: oneshot::Sender<()>,
}

impl Server {
    pub(crate) fn start() -> Server {
        Server::with(|_| ())
    }

    /// A server with the settings that `adapt` makes of the defaults. A client that connects before it serves waits.
    pub(crate) fn with(adapt: impl FnOnce(&mut Config)) -> Server {
        let mut config = Config::default();
        config.data.dir = DataConfig::MEMORY.into();
        config.zenoh.listen = ZenohConfig::OFF.into();
        config.http.listen = OFF.into();
        adapt(&mut config);
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        listener.set_nonblocking(true).unwrap();
        let uri = format!("http://{}", listener.local_addr().unwrap());
        let (stop, stopped) = oneshot::channel::<()>();
        std::thread::spawn(move || {
            let runtime = tokio::runtime::Runtime::new().unwrap();
            runtime.block_on(async {
                let listener = tokio::net::TcpListener::from_std(listener).unwrap();
                let stopped = async { drop(stopped.await) };
                // No test here depends on the result of the server.
                let _ = wayfold_server::run(config, listener, stopped).await;
            });
        });
        Server { uri, _stop: stop }
    }

    pub(crate) async fn client(&self) -> Client {
        Client::connect(&self.uri).await.unwrap()
    }

    /// A new index, and a client of its own.
    pub(crate) async fn index(&self, name: &str, space: &str) -> IndexHandle {
        let space = space.parse().unwrap();
        self.client()
            .await
            .create_index(name, &space)
            .await
            .unwrap()
    }
}
