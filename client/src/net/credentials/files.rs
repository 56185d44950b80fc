//! Credentials from files and from the environment.

use std::{
    env,
    ffi::OsString,
    fs,
    path::{Path, PathBuf},
};

use tokio_rustls::rustls::{
    self,
    crypto::ring,
    pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
    sign::CertifiedKey,
};

use super::Credentials;
use crate::Error;

const AUTHORITY: &str = "the certificate of the authority";
const CERTIFICATE: &str = "the client's certificate";
const KEY: &str = "the client's private key";
const TOKEN: &str = "the token";

impl Credentials {
    /// Those that the environment names by the variables of the command `wayfold`: the files `WAYFOLD_CA`, `WAYFOLD_CERT` and
    /// `WAYFOLD_KEY` in PEM, and `WAYFOLD_TOKEN`, or the file `WAYFOLD_TOKEN_FILE`. An empty variable counts as unset.
    ///
    /// # Errors
    /// [`Error::Credential`]: a file that cannot be read, or holds something else. [`Error::Argument`]: one of
    /// `WAYFOLD_CERT` and `WAYFOLD_KEY` alone.
    pub fn from_env() -> Result<Credentials, Error> {
        Credentials::from_variables(|name| env::var_os(name))
    }

    fn from_variables(variable: impl Fn(&str) -> Option<OsString>) -> Result<Credentials, Error> {
        let set = |name| variable(name).filter(|it| !it.is_empty());
        let file = |name| set(name).map(PathBuf::from);
        let mut credentials = Credentials::new();
        if let Some(ca) = file("WAYFOLD_CA") {
            credentials = credentials.ca_file(ca)?;
        }
        match (file("WAYFOLD_CERT"), file("WAYFOLD_KEY")) {
            (Some(certificate), Some(key)) => {
                credentials = credentials.client_certificate_files(certificate, key)?;
            }
            (None, None) => {}
            _ => {
                return Err(Error::Argument {
                    field: "WAYFOLD_CERT and WAYFOLD_KEY",
                    problem: "one is set alone: a certificate needs its private key".to_owned(),
                });
            }
        }
        match (set("WAYFOLD_TOKEN"), file("WAYFOLD_TOKEN_FILE")) {
            (Some(token), _) => Ok(credentials.token(token.to_string_lossy())),
            (None, Some(file)) => credentials.token_file(file),
            (None, None) => Ok(credentials),
        }
    }

    /// [`Credentials::ca_certificate`] from a file.
    ///
    /// # Errors
    /// [`Error::Credential`]: the file cannot be read, or has no certificate.
    pub fn ca_file(self, file: impl AsRef<Path>) -> Result<Credentials, Error> {
        let pem = read(AUTHORITY, file.as_ref())?;
        certificates(AUTHORITY, file.as_ref(), &pem)?;
        Ok(self.ca_certificate(pem))
    }

    /// [`Credentials::client_certificate`] from two files.
    ///
    /// # Errors
    /// [`Error::Credential`]: a file cannot be read, has no certificate or no key that can be used, or the two do not
    /// fit.
    pub fn client_certificate_files(
        self,
        certificate: impl AsRef<Path>,
        key: impl AsRef<Path>,
    ) -> Result<Credentials, Error> {
        let (certificate, key) = (certificate.as_ref(), key.as_ref());
        let (chain, secret) = (read(CERTIFICATE, certificate)?, read(KEY, key)?);
        let wrong_key = |problem| wrong(KEY, key, problem);
        let parsed = PrivateKeyDer::from_pem_slice(&secret)
            .map_err(|_| wrong_key("it has no private key in PEM".to_owned()))?;
        let certificates = certificates(CERTIFICATE, certificate, &chain)?;
        let fit = CertifiedKey::from_der(certificates, parsed, &ring::default_provider());
        fit.map_err(|error| match error {
            rustls::Error::InconsistentKeys(_) => wrong_key(format!(
                "it does not fit {}: {error}",
                certificate.display()
            )),
            rustls::Error::InvalidCertificate(_) => wrong(
                CERTIFICATE,
                certificate,
                format!("it cannot be used: {error}"),
            ),
            _ => wrong_key(format!("it cannot be used: {error}")),
        })?;
        Ok(self.client_certificate(chain, secret))
    }

    /// [`Credentials::token`] from a file, without the white space around it.
    ///
    /// # Errors
    /// [`Error::Credential`]: the file cannot be read, or is no text.
    pub fn token_file(self, file: impl AsRef<Path>) -> Result<Credentials, Error> {
        let text = String::from_utf8(read(TOKEN, file.as_ref())?)
            .map_err(|_| wrong(TOKEN, file.as_ref(), "it is no text".to_owned()))?;
        Ok(self.token(text.trim()))
    }
}

fn read(what: &'static str, file: &Path) -> Result<Vec<u8>, Error> {
    fs::read(file).map_err(|error| wrong(what, file, format!("it cannot be read: {error}")))
}

fn certificates(
    what: &'static str,
    file: &Path,
    pem: &[u8],
) -> Result<Vec<CertificateDer<'static>>, Error> {
    let read: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem).collect();
    let read = read.map_err(|error| wrong(what, file, error.to_string()))?;
    match read.is_empty() {
        true => Err(wrong(what, file, "it has no certificate in PEM".to_owned())),
        false => Ok(read),
    }
}

fn wrong(what: &'static str, file: &Path, problem: String) -> Error {
    Error::Credential {
        what,
        file: file.to_owned(),
        problem,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_variables_are_named() {
        let read = |set: &[(&str, &str)]| {
            let find = |name: &str| set.iter().find(|(known, _)| *known == name);
            Credentials::from_variables(|name| find(name).map(|(_, value)| value.into()))
        };
        let both = [("WAYFOLD_TOKEN", "x"), ("WAYFOLD_TOKEN_FILE", "missing")];
        assert_eq!(read(&both).unwrap().token.as_deref(), Some("x"));
        assert!(read(&[("WAYFOLD_TOKEN", "")]).unwrap().token.is_none());
        for (set, named) in [
            ([("WAYFOLD_TOKEN_FILE", "missing")], "the token, missing:"),
            ([("WAYFOLD_CA", "missing.pem")], "authority, missing.pem:"),
            (
                [("WAYFOLD_KEY", "client.key")],
                "WAYFOLD_CERT and WAYFOLD_KEY:",
            ),
        ] {
            let error = read(&set).unwrap_err().to_string();
            assert!(error.contains(named), "{error}");
        }
    }
}
