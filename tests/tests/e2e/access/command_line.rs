//! The command line with certificates and tokens.

use std::fs;

use wayfold_tests::{Process, ServerProcess};

use super::{Authority, authority::wayfold};

/// A certificate of X.509 version 1, which TLS libraries refuse. Made with OpenSSL 3.0: `openssl x509 -req` without
/// extensions.
const VERSION_1: &str = "-----BEGIN CERTIFICATE-----
MIIBFjCBvQIUWyA3C1dWMxrLGAqUThK+iCS8BjQwCgYIKoZIzj0EAwIwDTELMAkG
A1UEAwwCdjEwIBcNMjYxMTI2MDI1NTI0WhgPMjEyNjExMDIwMjU1MjRaMA0xCzAJ
BgNVBAMMAnYxMFkwEwYHKoZIzj0CAQYIKoZIzj0DAQcDQgAE77qmFC3H18wX6bFJ
o0ZiExPetVk7RTcv8b+H34HRgWI3Czh4rDck5UEdiiQo7lkCM1f9t3PnRyobUIdv
EXiYtzAKBggqhkjOPQQDAgNIADBFAiBZ10/BnTj9UR/5QxB7J9s/AzSoBAXAxo14
nrzq6jQyIgIhAJQ3/jgqu6eVxKJqu1oi68nXtR/l1Jg3vS6UJBvVe0Aq
-----END CERTIFICATE-----\n";

/// A private key in PEM whose bytes are no key.
const EMPTY_KEY: &str = "-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n";

#[test]
fn the_command_line_takes_certificates_and_tokens_and_says_what_is_wrong() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    authority.certify("server");
    authority.token("cell", "admin", "cell-*");
    let server = ServerProcess::ready(Process::spawn(&mut authority.command()));
    let uri = server.uri().to_owned();
    let ca = authority.file("ca", "pem");
    let token = authority.file("cell", "token");
    let (ca, token) = (ca.to_str().unwrap(), token.to_str().unwrap());
    let known = ["--server", &uri, "--ca", ca, "--token-file", token];
    let run = |options: &[&str], command: &[&str]| wayfold(&[options, command].concat());
    let created = run(&known, &["create", "cell-1", "--space", "R1"]);
    assert!(created.status.success(), "{}", created.stderr);
    for (options, command, status, part) in [
        (
            &known[..],
            &["create", "arm", "--space", "R1"][..],
            3,
            "no rights on the index",
        ),
        (
            &known[..4],
            &["info", "cell-1"],
            3,
            "neither a token (gRPC and HTTP: the header authorization",
        ),
        (
            &known[..2],
            &["info", "cell-1"],
            2,
            "https needs the certificate",
        ),
        (
            &["--ca", "missing.pem"],
            &["list"],
            2,
            "--ca: the certificate of the authority, missing.pem: it cannot be read",
        ),
        (&["--cert", ca], &["list"], 2, "--cert and --key"),
    ] {
        let refused = run(options, command);
        assert_eq!(refused.status.code(), Some(status), "{}", refused.stderr);
        assert!(refused.stderr.contains(part), "{}", refused.stderr);
    }
    // A token is written once, where no one else reads it.
    let again = [
        "token", "create", "x", "--role", "read", "--index", "*", "--to", token,
    ];
    assert!(wayfold(&again).stderr.contains("File exists"));
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        assert_eq!(
            fs::metadata(token).unwrap().permissions().mode() & 0o777,
            0o600
        );
    }
}

#[test]
fn a_wrong_certificate_is_named_by_its_option_and_ends_the_command() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    authority.certify("server");
    authority.certify("client");
    authority.token("cell", "admin", "cell-*");
    let server = ServerProcess::ready(Process::spawn(&mut authority.command()));
    let directory = tempfile::tempdir().unwrap();
    let other = Authority::new(directory.path());
    other.certify("stranger");
    let path = |of: &Authority, name, end| of.file(name, end).to_str().unwrap().to_owned();
    let ca = path(&authority, "ca", "pem");
    let (cert, key) = (
        path(&authority, "client", "pem"),
        path(&authority, "client", "key"),
    );
    let (token, stranger) = (
        path(&authority, "cell", "token"),
        path(&other, "stranger", "key"),
    );
    let forged = path(&other, "ca", "pem");
    authority.certify_expired("expired");
    let (expired, expired_key) = (
        path(&authority, "expired", "pem"),
        path(&authority, "expired", "key"),
    );
    let strangers = path(&other, "stranger", "pem");
    let (version_1, empty_key) = (
        path(&authority, "version_1", "pem"),
        path(&authority, "empty", "key"),
    );
    fs::write(&version_1, VERSION_1).unwrap();
    fs::write(&empty_key, EMPTY_KEY).unwrap();
    for (options, status, parts) in [
        (
            ["--ca", &token, "--cert", &cert, "--key", &key],
            2,
            ["--ca", &token, "no certificate"],
        ),
        (
            ["--ca", &ca, "--cert", &key, "--key", &key],
            2,
            ["--cert", &key, "no certificate"],
        ),
        (
            ["--ca", &ca, "--cert", &cert, "--key", &token],
            2,
            ["--key", &token, "no private key"],
        ),
        (
            ["--ca", &ca, "--cert", &cert, "--key", &stranger],
            2,
            ["--key", &stranger, &cert],
        ),
        (
            ["--ca", &ca, "--cert", &cert, "--key", &empty_key],
            2,
            ["--key", &empty_key, "cannot be used"],
        ),
        (
            ["--ca", &ca, "--cert", &version_1, "--key", &key],
            2,
            ["--cert", &version_1, "UnsupportedCertVersion"],
        ),
        (
            ["--ca", &forged, "--cert", &cert, "--key", &key],
            3,
            ["handshake", "invalid peer certificate", "--ca"],
        ),
        (
            ["--ca", &ca, "--cert", &expired, "--key", &expired_key],
            3,
            ["handshake", "refused the client's certificate", "--cert"],
        ),
        (
            ["--ca", &ca, "--cert", &strangers, "--key", &stranger],
            3,
            ["handshake", "refused the client's certificate", "--cert"],
        ),
    ] {
        // A retry would take this long.
        let command = ["list", "--server", server.uri(), "--timeout", "1h"];
        let refused = wayfold(&[&command[..], &options].concat());
        assert_eq!(refused.status.code(), Some(status), "{}", refused.stderr);
        for part in parts {
            assert!(refused.stderr.contains(part), "{part}: {}", refused.stderr);
        }
    }
}
