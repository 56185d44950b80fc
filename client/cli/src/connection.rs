//! The options that show the server who calls.

use std::{
    io::{self, Write},
    net::IpAddr,
    path::PathBuf,
};

use clap::{ArgMatches, parser::ValueSource};
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

    /// A file with the token, which counts if neither --token nor WAYFOLD_TOKEN is given
    #[arg(
        long,
        global = true,
        help_heading = HEADING,
        env = "WAYFOLD_TOKEN_FILE",
        value_name = "FILE"
    )]
    token_file: Option<PathBuf>,

    /// The options whose values come from variables of the environment.
    #[arg(skip)]
    variables: Vec<&'static str>,
}

impl ConnectionArgs {
    /// Remembers the values that come from variables, so that errors name the variable instead of the option.
    pub(super) fn note_variables(&mut self, matches: &ArgMatches) {
        let ids = ["ca", "cert", "key", "token_file"];
        let is_variable = |id: &&str| matches.value_source(id) == Some(ValueSource::EnvVariable);
        self.variables = ids.into_iter().filter(is_variable).collect();
    }

    /// The option, or the variable that set it.
    fn name(&self, id: &str) -> String {
        match self.variables.contains(&id) {
            true => format!("WAYFOLD_{}", id.to_uppercase()),
            false => format!("--{}", id.replace('_', "-")),
        }
    }

    /// Warns of a token that goes to an address beyond this machine without TLS.
    pub(super) fn warn(&self, addresses: &[String], format: Format) {
        let has_token = self.token.is_some() || self.token_file.is_some();
        let has_tls = self.ca.is_some() || self.cert.is_some();
        let mut addresses = addresses.iter().flat_map(|it| it.split(','));
        let Some(open) = addresses.find(|address| has_token && is_open(address, has_tls)) else {
            return;
        };
        let warning =
            format!("the token goes to {open} without TLS: everyone on the way can read it");
        let mut stderr = io::stderr();
        // Without standard error no one reads it.
        let _ = match format {
            Format::Text => writeln!(stderr, "warning: {warning}"),
            Format::Json => {
                output::json_line(&mut stderr, &serde_json::json!({ "warning": warning }))
            }
        };
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
        let wrong = |option| |source| Failure::Credential { option, source };
        let mut credentials = Credentials::new();
        if let Some(ca) = &self.ca {
            credentials = credentials.ca_file(ca).map_err(wrong(self.name("ca")))?;
        }
        match (&self.cert, &self.key) {
            (Some(cert), Some(key)) => {
                let option = format!("{} and {}", self.name("cert"), self.name("key"));
                let read = credentials.client_certificate_files(cert, key);
                credentials = read.map_err(wrong(option))?;
            }
            (None, None) => {}
            (cert, _) => {
                let given = self.name(if cert.is_some() { "cert" } else { "key" });
                return Err(Failure::HalfCertificate { given });
            }
        }
        match (&self.token, &self.token_file) {
            (Some(token), _) => Ok(credentials.token(token)),
            (None, Some(file)) => credentials
                .token_file(file)
                .map_err(wrong(self.name("token_file"))),
            (None, None) => Ok(credentials),
        }
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
