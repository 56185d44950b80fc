//! The same table for client certificates.

use std::{collections::HashMap, fs, net::SocketAddr, path::Path, time::Duration};

use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, DnType, IsCa, KeyPair};
use time::OffsetDateTime;
use tonic::{
    Code, Status,
    transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Error, Identity},
};

use super::{IDENTITIES, assert_rights, call, write_identities};
use crate::harness::{TestServer, reason};

const HOST: &str = "127.0.0.1";
/// The longest life of the certificate that expires while its connection is open.
const MAX_LIFE: Duration = Duration::from_secs(32);

/// An authority, and the certificates that it makes.
struct Authority(CertifiedIssuer<'static, KeyPair>);

impl Authority {
    fn new() -> Self {
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().unwrap();
        Self(CertifiedIssuer::self_signed(params, key).unwrap())
    }

    /// The certificate of a name and its key, in PEM, valid until `end`.
    fn certify(&self, name: &str, end: Option<OffsetDateTime>) -> (String, String) {
        let mut params = CertificateParams::new([HOST.to_owned()]).unwrap();
        params.distinguished_name.push(DnType::CommonName, name);
        params.not_after = end.unwrap_or(params.not_after);
        let key = KeyPair::generate().unwrap();
        let certificate = params.signed_by(&key, &self.0).unwrap();
        (certificate.pem(), key.serialize_pem())
    }

    /// A connection with this client certificate, or without any.
    async fn connect(
        &self,
        address: SocketAddr,
        client: Option<(String, String)>,
    ) -> Result<Channel, Error> {
        let mut tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(self.0.pem()));
        if let Some((certificate, key)) = client {
            tls = tls.identity(Identity::from_pem(certificate, key));
        }
        let endpoint = Endpoint::from_shared(format!("https://{address}"))?.tls_config(tls)?;
        endpoint.connect().await
    }

    /// A connection whose certificate expires while it is open.
    async fn connect_and_expire(&self, address: SocketAddr) -> Channel {
        let mut life = Duration::from_secs(2);
        loop {
            assert!(life <= MAX_LIFE);
            let end = OffsetDateTime::now_utc() + life;
            let client = self.certify("admin", Some(end));
            // A slow handshake ends after the certificate, which lives longer then.
            if let Ok(channel) = self.connect(address, Some(client)).await
                && !is_unknown(&knn(&channel).await)
            {
                while !is_unknown(&knn(&channel).await) {}
                return channel;
            }
            life *= 2;
        }
    }
}

/// The line of an identity's certificate.
fn certificate_line(name: &str) -> String {
    format!("certificate = \"{name}\"")
}

async fn knn(channel: &Channel) -> Result<(), Status> {
    call(channel, "PointService/Knn", None).await
}

/// True if the server does not know the caller, or did not accept its certificate.
fn is_unknown(answer: &Result<(), Status>) -> bool {
    let codes = [Code::Unauthenticated, Code::Unavailable, Code::Unknown];
    matches!(answer, Err(status) if codes.contains(&status.code()))
}

async fn start(authority: &Authority, directory: &Path) -> TestServer {
    let (certificate, key) = authority.certify("server", None);
    let [certificate, key, ca] = [
        ("server.pem", certificate),
        ("server.key", key),
        ("ca.pem", authority.0.pem()),
    ]
    .map(|(name, content)| {
        let file = directory.join(name);
        fs::write(&file, content).unwrap();
        file.to_str().unwrap().to_owned()
    });
    let identities = directory.join("identities.toml");
    write_identities(&identities, "", certificate_line);
    let adapt = |config: &mut wayfold_server::config::Config| {
        config.tls.certificate = certificate;
        config.tls.key = key;
        config.tls.client_ca = ca;
        config.access.identities = identities.to_str().unwrap().to_owned();
    };
    TestServer::start_for(adapt, async |address| {
        authority.connect(address, None).await.unwrap()
    })
    .await
}

#[tokio::test]
async fn every_call_refuses_every_wrong_certificate() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new();
    let server = start(&authority, directory.path()).await;
    let mut channels = HashMap::new();
    for name in IDENTITIES
        .map(|(name, ..)| name)
        .into_iter()
        .chain(["a stranger"])
    {
        let client = authority.certify(name, None);
        let channel = authority.connect(server.address, Some(client)).await;
        channels.insert(name, channel.unwrap());
    }
    let expired = authority.connect_and_expire(server.address).await;
    assert!(!is_unknown(&knn(&channels["revoked"]).await));
    let identities = directory.path().join("identities.toml");
    write_identities(&identities, "revoked", certificate_line);
    // The server looks at the file once a second.
    while !is_unknown(&knn(&channels["revoked"]).await) {}

    let strangers = [
        (&server.channel, "NO_CREDENTIAL"),
        (&channels["a stranger"], "WRONG_CREDENTIAL"),
        // The identity has expired, and the certificate has not.
        (&channels["expired"], "IDENTITY_EXPIRED"),
        (&expired, "IDENTITY_EXPIRED"),
        (&channels["revoked"], "WRONG_CREDENTIAL"),
    ];
    let strangers = strangers.map(|(channel, expected)| (channel, None, expected));
    assert_rights(&strangers, |name| (&channels[name], None)).await;

    // A certificate that has expired, or is of another authority, opens no connection.
    let past = OffsetDateTime::now_utc() - Duration::from_secs(60);
    let past = authority.certify("admin", Some(past));
    let foreign = Authority::new().certify("admin", None);
    for client in [past, foreign] {
        if let Ok(channel) = authority.connect(server.address, Some(client)).await {
            let status = knn(&channel).await.unwrap_err();
            assert!(status.details().is_empty(), "{status:?}");
        }
    }
    let status = knn(&expired).await.unwrap_err();
    assert_eq!(reason(&status, Code::Unauthenticated), "IDENTITY_EXPIRED");
    server.stop().await.unwrap().unwrap();
}
