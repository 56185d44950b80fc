//! The options that show the server who calls.

use std::{fs, path::PathBuf};

use wayfold::Credentials;

use crate::failure::Failure;

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
            credentials = credentials.ca_certificate(read("--ca", ca)?);
        }
        match (&self.cert, &self.key) {
            (Some(cert), Some(key)) => {
                let (cert, key) = (read("--cert", cert)?, read("--key", key)?);
                credentials = credentials.client_certificate(cert, key);
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

fn read(option: &'static str, file: &PathBuf) -> Result<Vec<u8>, Failure> {
    fs::read(file).map_err(|source| Failure::Credential {
        option,
        path: file.clone(),
        source,
    })
}
