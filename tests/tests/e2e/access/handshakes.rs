//! Servers that refuse the certificate of a client. Under TLS 1.3 the client's own handshake has succeeded by then.

use std::sync::Arc;

use tokio::net::{TcpListener, TcpStream};
use tokio_rustls::{
    TlsAcceptor,
    rustls::{
        RootCertStore, ServerConfig,
        pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
        server::WebPkiClientVerifier,
    },
};
use wayfold::{Client, Credentials, Error};
use wayfold_tests::{Process, ServerProcess, Signal};

use super::Authority;

/// Starts a server that refuses all clients, and returns its address. It verifies them by the authority `clients`, and
/// its alert always arrives, because its connections stay open. Without `clients` it closes each connection after the
/// handshake.
async fn refusing(authority: &Authority, clients: Option<&Authority>) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let uri = format!("https://{}", listener.local_addr().unwrap());
    let config = match clients {
        Some(clients) => {
            let mut roots = RootCertStore::empty();
            roots.add(clients.issuer.der().clone()).unwrap();
            let verifier = WebPkiClientVerifier::builder(Arc::new(roots)).build();
            ServerConfig::builder().with_client_cert_verifier(verifier.unwrap())
        }
        None => ServerConfig::builder().with_no_client_auth(),
    };
    let certificate = CertificateDer::from_pem_file(authority.file("server", "pem")).unwrap();
    let key = PrivateKeyDer::from_pem_file(authority.file("server", "key")).unwrap();
    let mut config = config.with_single_cert(vec![certificate], key).unwrap();
    config.alpn_protocols = vec![b"h2".to_vec()];
    let acceptor = TlsAcceptor::from(Arc::new(config));
    tokio::spawn(async move {
        let mut refused: Vec<TcpStream> = Vec::new();
        loop {
            let (socket, _) = listener.accept().await.unwrap();
            if let Err((_, socket)) = acceptor.accept(socket).into_fallible().await {
                refused.push(socket);
            }
        }
    });
    uri
}

async fn connect(credentials: &Credentials, uri: &str) -> Result<Client, Error> {
    let builder = Client::builder().credentials(credentials.clone());
    builder.connect(uri).await
}

#[tokio::test]
async fn a_refused_client_certificate_is_a_failed_handshake_with_and_without_an_alert() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    authority.certify("server");
    authority.certify_expired("client");
    let credentials = authority.with(&authority, "client");
    let alert = "received fatal alert: CertificateExpired";
    for (clients, cause) in [(Some(&authority), alert), (None, "")] {
        let uri = refusing(&authority, clients).await;
        let error = connect(&credentials, &uri).await.unwrap_err();
        let Error::Handshake { problem, .. } = error else {
            panic!("{error}");
        };
        let refused = "the server may have refused the client's certificate";
        assert!(problem.contains(refused), "{problem}");
        assert!(problem.contains(cause), "{problem}");
    }
}

#[tokio::test]
async fn an_alert_that_answers_a_call_is_a_failed_handshake() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    authority.certify("server");
    let uri = refusing(&authority, Some(&authority)).await;
    let client = connect(&authority.credentials(), &uri).await.unwrap();
    let error = client.server().await.unwrap_err();
    let Error::Handshake { problem, .. } = error else {
        panic!("{error}");
    };
    assert_eq!(problem, "received fatal alert: CertificateRequired");
}

#[tokio::test]
async fn one_of_several_servers_that_refuses_a_certificate_leaves_the_others() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    authority.certify("server");
    authority.certify("client");
    authority.token("reader", "read", "*");
    let other = tempfile::tempdir().unwrap();
    let other = Authority::new(other.path());
    let refusing = refusing(&authority, Some(&other)).await;
    let mut clients = Vec::new();
    let server = ServerProcess::ready(Process::spawn(&mut authority.command()));
    let credentials = authority.with(&authority, "client");
    for uris in [[&*refusing, server.uri()], [server.uri(), &*refusing]] {
        let client = connect(&credentials, &uris.join(",")).await.unwrap();
        assert!(client.is_serving().await.unwrap());
        clients.push(client);
    }
    server.stop(Signal::Kill);
    // The calls go on from each to the other.
    for client in clients {
        let error = client.is_serving().await.unwrap_err();
        assert!(matches!(error, Error::Connection { .. }), "{error}");
    }
}

#[tokio::test]
async fn a_server_that_is_down_has_refused_no_certificate() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    authority.certify("server");
    authority.certify("client");
    authority.token("reader", "read", "*");
    let server = ServerProcess::ready(Process::spawn(&mut authority.command()));
    let uri = server.uri().to_owned();
    server.stop(Signal::Kill);
    let credentials = authority.with(&authority, "client");
    let error = connect(&credentials, &uri).await.unwrap_err();
    assert!(matches!(error, Error::Connection { .. }), "{error}");
}
