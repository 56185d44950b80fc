//! TLS for the tests of connections.

use std::fs;

use rcgen::{CertificateParams, KeyPair};
use tokio::{io::AsyncWriteExt, time::timeout};
use tokio_rustls::{
    TlsConnector,
    client::TlsStream,
    rustls::{ClientConfig, pki_types::ServerName},
};

use super::*;

const SERVER: &str = "localhost";

/// After this time a write waits for the client.
const FULL_AFTER: Duration = Duration::from_millis(100);

/// A server's certificates, and a client that trusts them.
pub(crate) fn pair() -> (Tls, TlsConnector) {
    let directory = tempfile::tempdir().unwrap();
    let file = |name: &str, text: String| {
        let path = directory.path().join(name);
        fs::write(&path, text).unwrap();
        path
    };
    let key = KeyPair::generate().unwrap();
    let params = CertificateParams::new([SERVER.to_owned()]).unwrap();
    let certificate = params.self_signed(&key).unwrap();
    let tls = Tls::of(
        file("certificate.pem", certificate.pem()),
        file("key.pem", key.serialize_pem()),
        None,
    );
    let mut roots = RootCertStore::empty();
    roots.add(certificate.der().clone()).unwrap();
    let client = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    (tls.unwrap(), TlsConnector::from(Arc::new(client)))
}

/// The client's side of a connection, after the handshake.
pub(crate) async fn connect(connector: &TlsConnector, socket: TcpStream) -> TlsStream<TcpStream> {
    let server = ServerName::try_from(SERVER).unwrap();
    connector.connect(server, socket).await.unwrap()
}

/// Writes until the socket and the buffer of TLS are full.
pub(crate) async fn fill(connection: &mut (impl AsyncWrite + Unpin)) {
    let part = vec![0; 64 * 1024];
    while let Ok(written) = timeout(FULL_AFTER, connection.write(&part)).await {
        written.unwrap();
    }
}
