//! The pages for operators over TLS: a client certificate is an identity there too.

use std::{fs, sync::Arc};

use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
};
use tokio_rustls::{
    TlsConnector,
    rustls::{
        ClientConfig, RootCertStore,
        pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
    },
};
use wayfold_tests::{Process, ServerProcess, page};

use super::{Authority, BEYOND};

/// The first line and the body of the answer to a request of a client with this certificate, or without one.
async fn ask(
    authority: &Authority,
    address: &str,
    certificate: Option<&str>,
    (request, body): (&str, &str),
) -> (String, String) {
    let mut roots = RootCertStore::empty();
    roots.add(authority.issuer.der().clone()).unwrap();
    let config = ClientConfig::builder().with_root_certificates(roots);
    let config = match certificate {
        None => config.with_no_client_auth(),
        Some(name) => {
            let chain = CertificateDer::from_pem_file(authority.file(name, "pem")).unwrap();
            let key = PrivateKeyDer::from_pem_file(authority.file(name, "key")).unwrap();
            config.with_client_auth_cert(vec![chain], key).unwrap()
        }
    };
    let socket = TcpStream::connect(address).await.unwrap();
    let connector = TlsConnector::from(Arc::new(config));
    let name = "127.0.0.1".try_into().unwrap();
    let mut stream = connector.connect(name, socket).await.unwrap();
    let request = format!(
        "{request} HTTP/1.1\r\nHost: here\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{body}",
        body.len()
    );
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    // The server ends the socket without an end of TLS.
    let _ = stream.read_to_string(&mut answer).await;
    let (head, body) = answer.split_once("\r\n\r\n").expect("an answer");
    (head.lines().next().unwrap().to_owned(), body.to_owned())
}

#[test]
fn files_that_became_wrong_are_a_metric() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    authority.certify("server");
    let token = authority.token("prometheus", "read", "*");
    let mut server = authority.command();
    let server = server.args(["--http", "127.0.0.1:0"]);
    let mut server = ServerProcess::ready(Process::spawn(server));
    let address = server.pages();
    let header = format!("Authorization: Bearer {token}\r\n");
    for (label, file) in [
        ("identities", authority.file("identities", "toml")),
        ("certificates", authority.file("server", "pem")),
    ] {
        let says = |figure: u8| {
            let line = format!("wayfold_files_wrong{{file=\"{label}\"}} {figure}\n");
            page(&address, "/metrics", &header).1.contains(&line)
        };
        assert!(says(0));
        let content = fs::read(&file).unwrap();
        fs::remove_file(&file).unwrap();
        while !says(1) {}
        fs::write(&file, content).unwrap();
        while !says(0) {}
    }
}

#[tokio::test]
async fn a_certificate_has_its_rights_on_the_pages() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    for name in [
        "server",
        "prometheus.example",
        "cell.example",
        "nobody.example",
    ] {
        authority.certify(name);
    }
    let entry = |name: &str, indexes: &str, metrics: bool| {
        format!(
            "[[identity]]\nname = \"{name}\"\nrole = \"read\"\nindexes = [{indexes}]\nmetrics = {metrics}\n\
             certificate = \"{name}.example\"\n"
        )
    };
    let entries = entry("prometheus", "", true) + &entry("cell", "\"cell-*\"", false);
    fs::write(authority.file("identities", "toml"), entries).unwrap();
    let mut server = authority.command();
    let server = server.args(["--http", BEYOND]);
    let mut server = ServerProcess::ready(Process::spawn(server));
    let address = server.pages();
    const METRICS: (&str, &str) = ("GET /metrics", "");
    const SERVER: (&str, &str) = ("POST /api/v1/server", "{}");
    for (certificate, request, status, part) in [
        (None, METRICS, "401", "neither a token"),
        (Some("nobody.example"), METRICS, "401", "no identity"),
        (Some("cell.example"), METRICS, "403", "name all indices"),
        (Some("prometheus.example"), METRICS, "200", "wayfold_build"),
        (None, SERVER, "401", "neither a token"),
        (Some("cell.example"), SERVER, "200", "version"),
    ] {
        let (head, body) = ask(&authority, &address, certificate, request).await;
        assert!(head.contains(status), "{certificate:?} {head} {body}");
        assert!(body.contains(part), "{certificate:?} {head} {body}");
    }
}
