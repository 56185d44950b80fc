//! The listeners of a server, bound before anything else is opened.

use tokio::net::TcpListener;

use super::ServerError;
use crate::{
    cluster::{self, ClusterError},
    config::{ClusterConfig, Config, HttpConfig, OFF, ON},
    exposure::{self, ExposedAddress},
    faces::Addresses,
    grpc::{FaceListener, Tls},
    zenoh,
};

/// The listeners of a server.
pub(super) struct Listeners {
    pub(super) clients: FaceListener,
    pub(super) pages: Option<FaceListener>,
    pub(super) members: Option<FaceListener>,
    /// The address that this server tells the other members of its cluster.
    pub(super) advertised: Option<String>,
    /// Where the server is reached, without Zenoh's locators.
    pub(super) addresses: Addresses,
}

impl Listeners {
    /// Reads the certificates and binds the other listeners of the settings; `clients` is bound already.
    pub(super) async fn bind(config: &Config, clients: TcpListener) -> Result<Self, ServerError> {
        let grpc = clients.local_addr()?;
        let tls = Tls::open(&config.tls)?;
        let pages = bind_pages(&config.http).await?;
        let pages_at = pages.as_ref().map(TcpListener::local_addr).transpose()?;
        let members = bind_members(&config.cluster).await?;
        let members_at = members.as_ref().map(TcpListener::local_addr).transpose()?;
        let mut addresses = Addresses {
            grpc,
            pages: pages_at,
            members: members_at,
            has_tls: tls.is_some(),
            has_identities: config.access.identities().is_some(),
            zenoh: Vec::new(),
            warnings: Vec::new(),
        };
        addresses.warnings = check_exposure(config, &addresses)?;
        let member_tls = config.cluster.peer_ca().filter(|_| members.is_some());
        let member_tls = member_tls
            .map(|ca| Tls::of_members(&config.tls, ca))
            .transpose()?;
        let advertised = members_at
            .map(|at| cluster::advertised(&config.cluster, at))
            .transpose()?;
        let is_local = pages_at.is_some_and(|at| at.ip().is_loopback());
        Ok(Self {
            pages: pages.map(|socket| FaceListener {
                socket,
                // A machine trusts itself: a probe on it needs no certificate.
                tls: tls.clone().filter(|_| !is_local),
            }),
            members: members.map(|socket| FaceListener {
                socket,
                tls: member_tls,
            }),
            clients: FaceListener {
                socket: clients,
                tls,
            },
            advertised,
            addresses,
        })
    }
}

/// The listener of the pages for operators, unless they are off.
async fn bind_pages(config: &HttpConfig) -> Result<Option<TcpListener>, ServerError> {
    if config.listen == OFF {
        return Ok(None);
    }
    let bound = TcpListener::bind(&config.listen).await;
    bound.map(Some).map_err(|source| ServerError::Pages {
        listen: config.listen.clone(),
        source,
    })
}

/// The listener for the other members, if the server is in a cluster.
async fn bind_members(config: &ClusterConfig) -> Result<Option<TcpListener>, ClusterError> {
    if !config.is_on() {
        return Ok(None);
    }
    let bound = TcpListener::bind(&config.listen).await;
    bound.map(Some).map_err(|source| ClusterError::Listener {
        listen: config.listen.clone(),
        source,
    })
}

/// Refuses to reach beyond this machine without TLS and identities, unless that is allowed. Returns a warning for each
/// address that does.
fn check_exposure(config: &Config, addresses: &Addresses) -> Result<Vec<String>, ServerError> {
    let mut exposed = zenoh::exposed(&config.zenoh)?;
    let listens = [
        ("grpc.listen", Some(addresses.grpc)),
        ("http.listen", addresses.pages),
    ];
    for (setting, address) in listens {
        if let Some(address) = address.filter(|address| !address.ip().is_loopback()) {
            exposed.push(ExposedAddress {
                address: format!("{setting}: {address}"),
                has_tls: addresses.has_tls,
            });
        }
    }
    let has_identities = addresses.has_identities;
    let is_allowed = config.access.insecure == ON;
    let mut warnings = exposure::check(&exposed, has_identities, is_allowed)?;
    if let Some(address) = addresses.members {
        let has_certificates = config.cluster.peer_ca().is_some();
        let warning =
            exposure::check_members(address, has_certificates, has_identities, is_allowed)?;
        warnings.extend(warning);
    }
    Ok(warnings)
}
