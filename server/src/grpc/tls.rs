//! TLS for gRPC. The certificates are read again when their files change: new connections get the new ones, and those
//! that are open go on.

use std::{
    fmt, io,
    path::{Path, PathBuf},
    pin::Pin,
    sync::{Arc, OnceLock},
    task::{Context, Poll, ready},
    time::{Duration, SystemTime},
};

use parking_lot::RwLock;
use prometheus_client::metrics::gauge::Gauge;
use thiserror::Error;
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    net::{TcpListener, TcpStream},
};
use tokio_rustls::{
    Accept, TlsAcceptor,
    rustls::{
        self, RootCertStore, ServerConfig,
        crypto::ring,
        pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
        server::WebPkiClientVerifier,
    },
    server::TlsStream,
};
use tokio_util::either::Either;
use tracing::info;
use x509_parser::{extensions::GeneralName, prelude::FromDer, prelude::X509Certificate};

use crate::{
    config::TlsConfig,
    identity::{ClientCertificate, Stamp, follow},
};

/// The certificates cannot be used.
#[derive(Debug, Error)]
pub enum TlsError {
    /// A file is missing or wrong.
    #[error("{setting}: cannot use {}: {problem}", file.display())]
    File {
        /// The setting.
        setting: &'static str,
        /// The file.
        file: PathBuf,
        /// The problem.
        problem: String,
    },
    /// The files do not fit together.
    #[error("tls.certificate and tls.key do not fit: {0}")]
    Pair(#[from] rustls::Error),
    /// One of the two is missing.
    #[error("tls.certificate and tls.key are set together, or both are \"off\"")]
    Half,
    /// Members of a cluster show no certificates.
    #[error(
        "cluster.peer_ca needs tls.certificate and tls.key: the server shows them to the other members"
    )]
    Members,
}

/// The listener of a face, and its certificates if it speaks TLS.
pub(crate) struct FaceListener {
    pub(crate) socket: TcpListener,
    pub(crate) tls: Option<Tls>,
}

/// The certificates of the server. Clones share them.
#[derive(Clone)]
pub(crate) struct Tls {
    files: Arc<Files>,
    /// The states of the files before they were first read: a change since then shows.
    first: [Stamp; 3],
    acceptor: Arc<RwLock<TlsAcceptor>>,
}

struct Files {
    certificate: PathBuf,
    key: PathBuf,
    client_ca: Option<Authorities>,
}

/// The authorities of the certificates of clients.
struct Authorities {
    setting: &'static str,
    file: PathBuf,
    /// True if a client without a certificate is refused; otherwise it may have a token.
    is_required: bool,
}

impl Tls {
    /// Reads the certificates that the settings name; None if there are none.
    pub(crate) fn open(config: &TlsConfig) -> Result<Option<Self>, TlsError> {
        let (certificate, key) = match (config.certificate(), config.key()) {
            (Some(certificate), Some(key)) => (certificate.into(), key.into()),
            (None, None) if config.client_ca().is_none() => return Ok(None),
            _ => return Err(TlsError::Half),
        };
        let client_ca = config.client_ca().map(|file| Authorities {
            setting: "tls.client_ca",
            file: file.to_owned(),
            is_required: false,
        });
        Self::of(certificate, key, client_ca).map(Some)
    }

    /// Reads the certificates of the listener of a cluster, which accepts only clients with a certificate by the
    /// authorities in `peer_ca`.
    pub(crate) fn of_members(config: &TlsConfig, peer_ca: &Path) -> Result<Self, TlsError> {
        let (Some(certificate), Some(key)) = (config.certificate(), config.key()) else {
            return Err(TlsError::Members);
        };
        let client_ca = Authorities {
            setting: "cluster.peer_ca",
            file: peer_ca.to_owned(),
            is_required: true,
        };
        Self::of(certificate.into(), key.into(), Some(client_ca))
    }

    fn of(
        certificate: PathBuf,
        key: PathBuf,
        client_ca: Option<Authorities>,
    ) -> Result<Self, TlsError> {
        let files = Files {
            certificate,
            key,
            client_ca,
        };
        let first = files.stamps();
        let acceptor = Arc::new(RwLock::new(files.read()?));
        Ok(Self {
            files: Arc::new(files),
            first,
            acceptor,
        })
    }

    /// A connection that begins with a handshake if there is TLS. `client` gets the certificate of the client.
    pub(crate) fn accept(tls: Option<&Self>, socket: TcpStream, client: Client) -> Socket {
        let Some(tls) = tls else {
            return Either::Left(socket);
        };
        let handshake = tls.acceptor.read().accept(socket);
        Either::Right(TlsSocket {
            state: State::Shaking(Box::new(handshake)),
            client,
        })
    }

    /// Reads the certificates again whenever their files change. Files that are wrong change nothing but
    /// the gauge.
    pub(crate) async fn follow(self, is_wrong: Gauge) {
        // A certificate is often written before its key: the next change of either leads here again.
        let read = || {
            let acceptor = self.files.read()?;
            *self.acceptor.write() = acceptor;
            info!("certificates read");
            Ok::<_, TlsError>(())
        };
        let look = || self.files.stamps();
        let consequence = "the certificates stay as they were";
        follow(self.first, look, read, is_wrong, consequence).await;
    }
}

impl Files {
    fn stamps(&self) -> [Stamp; 3] {
        let client_ca = self.client_ca.as_ref().map_or(&self.key, |it| &it.file);
        [&self.certificate, &self.key, client_ca].map(|file| Stamp::of(file))
    }

    fn read(&self) -> Result<TlsAcceptor, TlsError> {
        let provider = Arc::new(ring::default_provider());
        let builder = ServerConfig::builder_with_provider(Arc::clone(&provider))
            .with_safe_default_protocol_versions()?;
        let builder = match &self.client_ca {
            None => builder.with_no_client_auth(),
            Some(Authorities {
                setting,
                file,
                is_required,
            }) => {
                let mut roots = RootCertStore::empty();
                for root in certificates(setting, file)? {
                    roots.add(root).map_err(in_file(setting, file))?;
                }
                let verifier =
                    WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
                let verifier = match is_required {
                    true => verifier,
                    false => verifier.allow_unauthenticated(),
                };
                let verifier = verifier.build().map_err(in_file(setting, file))?;
                builder.with_client_cert_verifier(verifier)
            }
        };
        let chain = certificates("tls.certificate", &self.certificate)?;
        let key = PrivateKeyDer::from_pem_file(&self.key).map_err(in_file("tls.key", &self.key))?;
        let mut config = builder.with_single_cert(chain, key)?;
        // The second is for the pages of operators.
        config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
        Ok(TlsAcceptor::from(Arc::new(config)))
    }
}

fn certificates(
    setting: &'static str,
    file: &Path,
) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let read = CertificateDer::pem_file_iter(file).and_then(Iterator::collect);
    let read: Vec<_> = read.map_err(in_file(setting, file))?;
    match read.is_empty() {
        true => Err(in_file(setting, file)("it has no certificate")),
        false => Ok(read),
    }
}

fn in_file<E: fmt::Display>(setting: &'static str, file: &Path) -> impl Fn(E) -> TlsError {
    move |problem| TlsError::File {
        setting,
        file: file.to_owned(),
        problem: problem.to_string(),
    }
}

/// A connection, with TLS or without.
pub(crate) type Socket = Either<TcpStream, TlsSocket>;

/// The verified certificate of a client, once the handshake is done; none without one.
pub(crate) type Client = Arc<OnceLock<ClientCertificate>>;

/// A connection with TLS, whose handshake takes place as it is first read or written.
pub(crate) struct TlsSocket {
    state: State,
    client: Client,
}

enum State {
    Shaking(Box<Accept<TcpStream>>),
    Open(Box<TlsStream<TcpStream>>),
}

impl TlsSocket {
    fn poll_open(
        &mut self,
        context: &mut Context<'_>,
    ) -> Poll<io::Result<Pin<&mut TlsStream<TcpStream>>>> {
        if let State::Shaking(handshake) = &mut self.state {
            let stream = ready!(Pin::new(handshake).poll(context))?;
            let chain = stream.get_ref().1.peer_certificates();
            if let Some(certificate) = chain.and_then(<[_]>::first).and_then(|it| read(it)) {
                // A connection has one handshake.
                let _ = self.client.set(certificate);
            }
            self.state = State::Open(Box::new(stream));
        }
        match &mut self.state {
            State::Open(stream) => Poll::Ready(Ok(Pin::new(stream))),
            State::Shaking(_) => Poll::Pending,
        }
    }
}

/// Reads a certificate that was verified.
fn read(certificate: &[u8]) -> Option<ClientCertificate> {
    let (_, certificate) = X509Certificate::from_der(certificate).ok()?;
    let expires = u64::try_from(certificate.validity().not_after.timestamp()).unwrap_or(0);
    let common = certificate.subject().iter_common_name();
    let common = common.filter_map(|name| name.as_str().ok());
    let alternative = certificate.subject_alternative_name().ok().flatten();
    let alternative = alternative.map(|extension| &extension.value.general_names);
    let others = alternative
        .into_iter()
        .flatten()
        .filter_map(|name| match name {
            GeneralName::DNSName(name) | GeneralName::URI(name) => Some(*name),
            _ => None,
        });
    Some(ClientCertificate {
        names: common.chain(others).map(str::to_owned).collect(),
        expires: SystemTime::UNIX_EPOCH + Duration::from_secs(expires),
    })
}

impl AsyncRead for TlsSocket {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        ready!(self.poll_open(context))?.poll_read(context, buffer)
    }
}

impl AsyncWrite for TlsSocket {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        ready!(self.poll_open(context))?.poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        ready!(self.poll_open(context))?.poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        true
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        ready!(self.poll_open(context))?.poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.state {
            // There is nothing to end.
            State::Shaking(_) => Poll::Ready(Ok(())),
            State::Open(stream) => Pin::new(stream).poll_shutdown(context),
        }
    }
}

#[cfg(test)]
pub(crate) mod testing;

#[cfg(test)]
mod tests {
    use rcgen::{CertificateParams, DnType, KeyPair, date_time_ymd};

    use super::*;

    #[test]
    fn a_certificate_has_its_names_and_its_end() {
        let mut params = CertificateParams::new(["cell.example".to_owned()]).unwrap();
        params.distinguished_name.push(DnType::CommonName, "cell");
        params.not_after = date_time_ymd(2027, 1, 31);
        let certificate = params.self_signed(&KeyPair::generate().unwrap()).unwrap();
        let certificate = read(certificate.der()).unwrap();
        assert!(certificate.names.contains(&"cell".to_owned()));
        assert!(certificate.names.contains(&"cell.example".to_owned()));
        assert_eq!(certificate.expires, date_time_ymd(2027, 1, 31));
    }
}
