//! The certificates and the token of a connection.

mod files;

use std::{fmt, sync::Arc};

use tonic::{
    Request, Status,
    metadata::{Ascii, MetadataValue},
    service::Interceptor,
    transport::{Certificate, ClientTlsConfig, Identity},
};

use super::trace;
use crate::Error;

/// The certificates and the token by which a client and its server identify each other. Clones share them.
///
/// ```no_run
/// use wayfold::{Client, Credentials};
///
/// # async fn connect() -> Result<(), wayfold::Error> {
/// let credentials = Credentials::new().ca_file("ca.pem")?.token_file("cell-3.token")?;
/// let client = Client::builder().credentials(credentials).connect("https://planning.example:50051").await?;
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Default)]
pub struct Credentials {
    ca: Option<Arc<[u8]>>,
    identity: Option<Arc<(Vec<u8>, Vec<u8>)>>,
    token: Option<Arc<str>>,
}

impl Credentials {
    /// None of them.
    pub fn new() -> Credentials {
        Credentials::default()
    }

    /// The certificates of the authorities that certify the server, in PEM. An address with `https` needs them.
    pub fn ca_certificate(mut self, pem: impl Into<Vec<u8>>) -> Credentials {
        self.ca = Some(pem.into().into());
        self
    }

    /// The certificate of this client, and those between it and its authority, with its private key, both in PEM.
    pub fn client_certificate(
        mut self,
        certificate: impl Into<Vec<u8>>,
        key: impl Into<Vec<u8>>,
    ) -> Credentials {
        self.identity = Some(Arc::new((certificate.into(), key.into())));
        self
    }

    /// The token of an identity of the server. Without TLS everyone on the way can read it.
    pub fn token(mut self, token: impl Into<String>) -> Credentials {
        self.token = Some(token.into().into());
        self
    }

    /// The attachment of a query: the token and the trace of this task.
    #[cfg(feature = "zenoh")]
    pub(crate) fn attachment(&self) -> Option<String> {
        let token = self.token.as_ref().map(|token| format!("token={token}"));
        let parts: Vec<String> = token.into_iter().chain(trace::parameter()).collect();
        (!parts.is_empty()).then(|| parts.join(";"))
    }

    /// True if a connection needs TLS.
    pub(crate) fn wants_tls(&self) -> bool {
        self.ca.is_some() || self.identity.is_some()
    }

    pub(crate) fn has_client_certificate(&self) -> bool {
        self.identity.is_some()
    }

    pub(crate) fn tls(&self) -> Option<ClientTlsConfig> {
        let ca = Certificate::from_pem(self.ca.as_ref()?);
        let tls = ClientTlsConfig::new().ca_certificate(ca);
        Some(match self.identity.as_deref() {
            Some((certificate, key)) => tls.identity(Identity::from_pem(certificate, key)),
            None => tls,
        })
    }

    /// Adds the token to each call.
    pub(crate) fn bearer(&self) -> Result<Bearer, Error> {
        let Some(token) = &self.token else {
            return Ok(Bearer(None));
        };
        let value = format!("Bearer {token}").parse::<MetadataValue<Ascii>>();
        let mut value = value.map_err(|_| Error::Argument {
            field: "token",
            problem: "it has characters that no token has".to_owned(),
        })?;
        value.set_sensitive(true);
        Ok(Bearer(Some(value)))
    }
}

impl fmt::Debug for Credentials {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Credentials")
            .field("ca_certificate", &self.ca.is_some())
            .field("client_certificate", &self.identity.is_some())
            .field("token", &self.token.is_some())
            .finish()
    }
}

/// Adds a token to each call, or nothing, and the trace of its task.
#[derive(Clone, Debug)]
pub(crate) struct Bearer(Option<MetadataValue<Ascii>>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        let metadata = request.metadata_mut();
        trace::mark(metadata);
        if let Some(token) = &self.0 {
            metadata.insert("authorization", token.clone());
        }
        Ok(request)
    }
}
