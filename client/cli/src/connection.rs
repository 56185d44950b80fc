//! The options that show the server who calls.

use std::{
    fmt, fs,
    io::{self, Write},
    net::IpAddr,
    path::{Path, PathBuf},
};

use tokio_rustls::rustls::{
    crypto::ring,
    pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
    sign::CertifiedKey,
};
use wayfold::Credentials;

use crate::{
    failure::Failure,
    output::{self, Format},
};

const HEADING: &str = "Options of every command";

/// Certificates and a token.
#[derive(Debug, Default, clap::Args)]
pub(super) struct ConnectionArgs {
    /// The certificate of the authority that certifies the server, in PEM: for https
    #[arg(long, global = true, help_heading = HEADING, env = "WAYFOLD_CA", value_name = "FILE")]
    ca: Option<PathBuf>,

    /// The certificate of this client, in PEM
    #[arg(long, global = true, help_heading = HEADING, env = "WAYFOLD_CERT", value_name = "FILE")]
    cert: Option<PathBuf>,

    /// The private key of that certificate, in PEM
    #[arg(long, global = true, help_heading = HEADING, env = "WAYFOLD_KEY", value_name = "FILE")]
    key: Option<PathBuf>,

    /// The token of an identity. Others on this machine see arguments: a file or the environment hides it
    #[arg(
        long,
        global = true,
        help_heading = HEADING,
        env = "WAYFOLD_TOKEN",
        hide_env_values = true,
        value_name = "TOKEN"
    )]
    token: Option<String>,

    /// A file with the token, which counts if --token is not given
    #[arg(
        long,
        global = true,
        help_heading = HEADING,
        env = "WAYFOLD_TOKEN_FILE",
        value_name = "FILE"
    )]
    token_file: Option<PathBuf>,
}

impl ConnectionArgs {
    /// Warns of a token that goes to an address beyond this machine without TLS.
    pub(super) fn warn(&self, addresses: &[String], format: Format) -> io::Result<()> {
        let has_token = self.token.is_some() || self.token_file.is_some();
        let has_tls = self.ca.is_some() || self.cert.is_some();
        let mut addresses = addresses.iter().flat_map(|it| it.split(','));
        let Some(open) = addresses.find(|address| has_token && is_open(address, has_tls)) else {
            return Ok(());
        };
        let warning =
            format!("the token goes to {open} without TLS: everyone on the way can read it");
        let mut stderr = io::stderr();
        match format {
            Format::Text => writeln!(stderr, "warning: {warning}"),
            Format::Json => {
                output::json_line(&mut stderr, &serde_json::json!({ "warning": warning }))
            }
        }
    }

    /// The certificates as Zenoh's configuration names them. A link over TCP reads none.
    pub(super) fn zenoh_tls(&self) -> serde_json::Value {
        serde_json::json!({
            "root_ca_certificate": self.ca,
            "connect_certificate": self.cert,
            "connect_private_key": self.key,
            "enable_mtls": self.cert.is_some(),
        })
    }

    /// Reads the files.
    pub(super) fn credentials(&self) -> Result<Credentials, Failure> {
        let mut credentials = Credentials::new();
        if let Some(ca) = &self.ca {
            let pem = read("--ca", ca)?;
            certificates("--ca", ca, &pem)?;
            credentials = credentials.ca_certificate(pem);
        }
        match (&self.cert, &self.key) {
            (Some(cert), Some(key)) => {
                let (chain, secret) = (read("--cert", cert)?, read("--key", key)?);
                check_pair((cert, &chain), (key, &secret))?;
                credentials = credentials.client_certificate(chain, secret);
            }
            (None, None) => {}
            _ => return Err(Failure::HalfCertificate),
        }
        let token = match (&self.token, &self.token_file) {
            (Some(token), _) => Some(token.clone()),
            (None, Some(file)) => {
                let text = read("--token-file", file)?;
                Some(String::from_utf8_lossy(&text).trim().to_owned())
            }
            (None, None) => None,
        };
        Ok(match token {
            Some(token) => credentials.token(token),
            None => credentials,
        })
    }
}

/// True for an address of gRPC or Zenoh beyond this machine without TLS. gRPC has TLS without a scheme if `has_tls`.
fn is_open(address: &str, has_tls: bool) -> bool {
    let rest = match address.split_once("://").or(address.split_once('/')) {
        Some(("http" | "tcp" | "udp" | "ws", rest)) => rest,
        None if !has_tls => address,
        _ => return false,
    };
    let host = rest.trim_end_matches('/').rsplit_once(':');
    let host = host.map_or(rest, |(host, _)| host).trim_matches(['[', ']']);
    let is_loopback = host.parse().is_ok_and(|ip: IpAddr| ip.is_loopback());
    host != "localhost" && !is_loopback
}

fn certificates(
    option: &'static str,
    file: &Path,
    pem: &[u8],
) -> Result<Vec<CertificateDer<'static>>, Failure> {
    let read: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem).collect();
    match read {
        Ok(read) if read.is_empty() => Err(wrong(option, file)("it has no certificate in PEM")),
        read => read.map_err(wrong(option, file)),
    }
}

/// Refuses a private key that is none, or not that of the certificate.
fn check_pair(cert: (&Path, &[u8]), key: (&Path, &[u8])) -> Result<(), Failure> {
    let chain = certificates("--cert", cert.0, cert.1)?;
    let secret = PrivateKeyDer::from_pem_slice(key.1)
        .map_err(|_| wrong("--key", key.0)("it has no private key in PEM"))?;
    let fits = CertifiedKey::from_der(chain, secret, &ring::default_provider());
    let fits = fits.map_err(|error| {
        let problem = format!("it does not fit --cert {}: {error}", cert.0.display());
        wrong("--key", key.0)(problem)
    });
    fits.map(drop)
}

fn wrong<E: fmt::Display>(option: &'static str, file: &Path) -> impl Fn(E) -> Failure {
    move |problem| Failure::WrongCredential {
        option,
        path: file.to_owned(),
        problem: problem.to_string(),
    }
}

fn read(option: &'static str, file: &PathBuf) -> Result<Vec<u8>, Failure> {
    fs::read(file).map_err(|source| Failure::Credential {
        option,
        path: file.clone(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_beyond_this_machine_without_tls_are_open() {
        for open in [
            "http://planning:50051",
            "planning:50051",
            "http://[fe80::1]:1/",
            "tcp/10.0.0.1:7448",
        ] {
            assert!(is_open(open, false), "{open}");
        }
        for closed in [
            "https://planning:50051",
            "http://127.0.0.1:50051",
            "http://[::1]:1/",
            "localhost:1",
            "tls/10.0.0.1:7448",
            "tcp/127.0.0.1:7448",
        ] {
            assert!(!is_open(closed, false), "{closed}");
        }
        assert!(!is_open("planning:50051", true));
    }
}
