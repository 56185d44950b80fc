//! An authority that certifies names and makes identities, and the command of a server with both.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, DnType, IsCa, KeyPair};
use tokio_rustls::rustls::pki_types::CertificateDer;
use wayfold::Credentials;
use wayfold_tests::{Process, ProcessOutput};

/// An authority, in a directory with its files.
pub(crate) struct Authority {
    pub(crate) issuer: CertifiedIssuer<'static, KeyPair>,
    directory: PathBuf,
}

impl Authority {
    pub(crate) fn new(directory: &Path) -> Self {
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let issuer = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
        fs::write(directory.join("ca.pem"), issuer.pem()).unwrap();
        Self {
            issuer,
            directory: directory.to_owned(),
        }
    }

    /// Certifies a name, for 127.0.0.1 too: writes NAME.pem and NAME.key, each whole or not at all.
    pub(crate) fn certify(&self, name: &str) -> CertificateDer<'static> {
        self.certify_with(name, |_| {})
    }

    /// Acts like [`Authority::certify`]; the certificate expired in 2001.
    pub(crate) fn certify_expired(&self, name: &str) {
        self.certify_with(name, |params| {
            params.not_after = rcgen::date_time_ymd(2001, 1, 1)
        });
    }

    fn certify_with(
        &self,
        name: &str,
        change: impl FnOnce(&mut CertificateParams),
    ) -> CertificateDer<'static> {
        let names = [name.to_owned(), "127.0.0.1".to_owned()];
        let mut params = CertificateParams::new(names).unwrap();
        params.distinguished_name.push(DnType::CommonName, name);
        change(&mut params);
        let key = KeyPair::generate().unwrap();
        let certificate = params.signed_by(&key, &self.issuer).unwrap();
        for (end, pem) in [("key", key.serialize_pem()), ("pem", certificate.pem())] {
            let whole = self.directory.join("whole");
            fs::write(&whole, pem).unwrap();
            fs::rename(whole, self.file(name, end)).unwrap();
        }
        certificate.der().clone()
    }

    pub(crate) fn file(&self, name: &str, end: &str) -> PathBuf {
        self.directory.join(format!("{name}.{end}"))
    }

    /// The credentials of a client with this certificate of the authority `of`.
    pub(crate) fn with(&self, of: &Authority, name: &str) -> Credentials {
        let [certificate, key] = ["pem", "key"].map(|end| of.file(name, end));
        let credentials = self.credentials();
        credentials
            .client_certificate_files(certificate, key)
            .unwrap()
    }

    pub(crate) fn credentials(&self) -> Credentials {
        Credentials::new().ca_file(self.file("ca", "pem")).unwrap()
    }

    /// Makes a token with the command line, and returns it; its entry joins the file of identities.
    pub(crate) fn token(&self, name: &str, role: &str, index: &str) -> String {
        let token = self.file(name, "token");
        let arguments = ["token", "create", name, "--role", role, "--index", index];
        let to = token.to_str().unwrap();
        let to = ["--expires", "2999-12-31T23:59:59+01:00", "--to", to];
        let made = wayfold(&[&arguments[..], &to].concat());
        assert!(made.status.success(), "{}", made.stderr);
        let before = fs::read_to_string(self.file("identities", "toml")).unwrap_or_default();
        let entry = made.stdout.join("\n");
        fs::write(
            self.file("identities", "toml"),
            format!("{before}{entry}\n"),
        )
        .unwrap();
        fs::read_to_string(token).unwrap().trim().to_owned()
    }

    /// The command of a server with the certificate `server` and these identities.
    pub(crate) fn command(&self) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
        command
            .args(["--grpc", "127.0.0.1:0", "--data", "memory"])
            .env("WAYFOLD_TLS__CERTIFICATE", self.file("server", "pem"))
            .env("WAYFOLD_TLS__KEY", self.file("server", "key"))
            .env("WAYFOLD_TLS__CLIENT_CA", self.file("ca", "pem"))
            .env(
                "WAYFOLD_ACCESS__IDENTITIES",
                self.file("identities", "toml"),
            );
        command
    }
}

/// Runs the command line.
pub(crate) fn wayfold(arguments: &[&str]) -> ProcessOutput {
    Process::start(env!("CARGO_BIN_EXE_cli-process"), arguments).finish()
}
