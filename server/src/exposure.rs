//! Beyond this machine nothing is served without TLS and identities, unless the operator asks for it by name.

use std::net::{IpAddr, SocketAddr};

use thiserror::Error;
use tracing::warn;

/// An address that reaches callers beyond this machine: one that is listened on, or a router to connect to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ExposedAddress {
    /// The address, with its setting.
    pub(crate) address: String,
    /// True if it speaks TLS.
    pub(crate) has_tls: bool,
}

/// Strangers could read and change every index.
#[derive(Debug, Error)]
pub enum ExposedError {
    /// Callers beyond this machine could.
    #[error(
        "{address} reaches beyond this machine without {missing}: everyone there could read and change every index\n  \
         set {settings}, use an address of this machine (127.0.0.1), or allow it with --insecure"
    )]
    Callers {
        /// The address, with its setting.
        address: String,
        /// The missing protection.
        missing: &'static str,
        /// The settings that give it.
        settings: &'static str,
    },
    /// So can every process that reaches the address for the members of a cluster.
    #[error(
        "{address} takes calls of the other servers without their certificates: everyone who reaches it would act for every \
         identity\n  set cluster.peer_ca, tls.certificate and tls.key, or allow it with --insecure"
    )]
    Members {
        /// The address, with its setting.
        address: String,
    },
}

/// Refuses `exposed` addresses without TLS or identities. With `is_allowed`, each is a warning in the log, which a filter may
/// drop, and one of the returned texts.
pub(crate) fn check(
    exposed: &[ExposedAddress],
    has_identities: bool,
    is_allowed: bool,
) -> Result<Vec<String>, ExposedError> {
    let mut warnings = Vec::new();
    for ExposedAddress { address, has_tls } in exposed {
        let (missing, settings) = match (has_tls, has_identities) {
            (true, true) => continue,
            (false, true) => ("TLS", "tls.certificate and tls.key, or a locator tls/…"),
            (true, false) => ("identities", "access.identities"),
            (false, false) => (
                "TLS and identities",
                "tls.certificate and tls.key (for Zenoh, a locator tls/…) and access.identities",
            ),
        };
        if !is_allowed {
            return Err(ExposedError::Callers {
                address: address.clone(),
                missing,
                settings,
            });
        }
        warn!(
            address,
            missing, "insecure: everyone who reaches this address can read and change every index"
        );
        warnings.push(format!(
            "insecure, without {missing}: everyone who reaches {address} can read and change every index"
        ));
    }
    Ok(warnings)
}

/// Refuses an address for the other members of a cluster where anyone could speak for a member; the same as [`check`].
pub(crate) fn check_members(
    address: SocketAddr,
    has_certificates: bool,
    has_identities: bool,
    is_allowed: bool,
) -> Result<Option<String>, ExposedError> {
    if has_certificates || (address.ip().is_loopback() && !has_identities) {
        return Ok(None);
    }
    let address = format!("cluster.listen: {address}");
    if !is_allowed {
        return Err(ExposedError::Members { address });
    }
    warn!(
        address,
        "insecure: everyone who reaches this address acts for every identity"
    );
    Ok(Some(format!(
        "insecure: everyone who reaches {address} acts for every identity"
    )))
}

/// True if a host is this machine, by its loopback interface.
pub(crate) fn is_local(host: &str) -> bool {
    let address = host.trim_start_matches('[').trim_end_matches(']');
    let address = address.parse::<IpAddr>();
    host == "localhost" || address.is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_that_begins_like_an_address_of_this_machine_is_not_local() {
        for host in ["127.0.0.1", "127.8.9.1", "[::1]", "::1", "localhost"] {
            assert!(is_local(host), "{host}");
        }
        for host in [
            "127.0.0.1.example.com",
            "0.0.0.0",
            "[::]",
            "10.0.0.7",
            "example.com",
        ] {
            assert!(!is_local(host), "{host}");
        }
    }

    #[test]
    fn an_address_needs_both_or_leave() {
        for (has_tls, has_identities, missing) in [
            (true, true, None),
            (false, true, Some("TLS")),
            (true, false, Some("identities")),
            (false, false, Some("TLS and identities")),
        ] {
            let exposed = [ExposedAddress {
                address: "grpc.listen = 0.0.0.0:1".into(),
                has_tls,
            }];
            let refused = check(&exposed, has_identities, false);
            let found = refused.err().map(|error| match error {
                ExposedError::Callers { missing, .. } => missing,
                ExposedError::Members { .. } => "members",
            });
            assert_eq!(found, missing);
            let warnings = check(&exposed, has_identities, true).unwrap();
            assert_eq!(warnings.len(), usize::from(missing.is_some()));
        }
    }

    #[test]
    fn an_address_for_members_needs_certificates_unless_only_this_machine_reaches_it() {
        let (loopback, remote) = (
            "127.0.0.1:1".parse().unwrap(),
            "10.0.0.7:1".parse().unwrap(),
        );
        for (address, has_certificates, has_identities, is_safe) in [
            (loopback, false, false, true),
            (loopback, false, true, false),
            (loopback, true, true, true),
            (remote, false, false, false),
            (remote, false, true, false),
            (remote, true, false, true),
        ] {
            let checked = check_members(address, has_certificates, has_identities, false);
            assert_eq!(checked.is_ok(), is_safe, "{address}");
            let warning = check_members(address, has_certificates, has_identities, true);
            assert_eq!(warning.unwrap().is_none(), is_safe, "{address}");
        }
    }
}
