//! NATS with TLS and users: a server works with the right settings, and with a wrong one it ends and names the setting.
//! The environment variable `NATS_SERVER` has the path of the program nats-server.

use std::{fs, process::Command};

use base64::{Engine as _, prelude::BASE64_URL_SAFE_NO_PAD};
use rcgen::{CertificateParams, DnType, KeyPair};
use serde_json::json;
use tokio::time::timeout;
use wayfold_tests::{
    Process, ServerProcess, Stubs,
    nats::{Nats, member_settings},
};

use crate::journal_loss::{MAX_WAIT, insert_until_acknowledged};

/// The token by which a key admits another one. An account that may store no byte has no JetStream.
fn admit(by: &nkeys::KeyPair, other: &nkeys::KeyPair, kind: &str, bytes: i64) -> String {
    // A missing limit would be 0; -1 is no limit.
    let claims = json!({ "iss": by.public_key(), "sub": other.public_key(), "nats": {
        "type": kind, "version": 2, "subs": -1, "payload": -1, "limits": {
            "subs": -1, "payload": -1, "conn": -1, "streams": -1, "consumer": -1,
            "mem_storage": bytes, "disk_storage": bytes,
        },
    } });
    let header = json!({ "typ": "JWT", "alg": "ed25519-nkey" });
    let signed = [header, claims].map(|it| BASE64_URL_SAFE_NO_PAD.encode(it.to_string()));
    let signed = signed.join(".");
    let signature = by.sign(signed.as_bytes()).unwrap();
    format!("{signed}.{}", BASE64_URL_SAFE_NO_PAD.encode(signature))
}

/// The configuration of an operator with an account, and the credentials of a user of the account.
fn operator() -> (String, String) {
    use nkeys::KeyPair;
    let (operator, system) = (KeyPair::new_operator(), KeyPair::new_account());
    let (account, user) = (KeyPair::new_account(), KeyPair::new_user());
    // Under an operator JetStream needs a system account.
    let config = format!(
        "operator: {0}\nsystem_account: {1}\nresolver: MEMORY\nresolver_preload {{\n{1}: {2}\n{3}: {4}\n}}",
        admit(&operator, &operator, "operator", 0),
        system.public_key(),
        admit(&operator, &system, "account", 0),
        account.public_key(),
        admit(&operator, &account, "account", -1),
    );
    let credentials = format!(
        "-----BEGIN NATS USER JWT-----\n{}\n------END NATS USER JWT------\n\n\
         -----BEGIN USER NKEY SEED-----\n{}\n------END USER NKEY SEED------\n",
        admit(&account, &user, "user", 0),
        user.seed().unwrap(),
    );
    (config, credentials)
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_needs_the_authority_and_a_user_of_nats() {
    const NO_USER: &str = "authorization violation; set cluster.credentials";
    let directory = tempfile::tempdir().unwrap();
    let file = |name: &str| directory.path().join(name);
    let write = |name: &str, text: String| fs::write(file(name), text).unwrap();
    // The key of the second one stays in its file.
    for name in ["other", "ca"] {
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::new(["127.0.0.1".to_owned()]).unwrap();
        params.distinguished_name.push(DnType::CommonName, name);
        write(name, params.self_signed(&key).unwrap().pem());
        write("key", key.serialize_pem());
    }
    let (accounts, user) = operator();
    write("user", user);
    write("stranger", operator().1);
    let (certificate, key) = (file("ca"), file("key"));
    let with_tls = format!("tls {{ cert_file: {certificate:?}, key_file: {key:?} }}\n{accounts}");
    let with_password = "authorization { user: me, password: right }";
    let with_another = "authorization { user: me, password: another }";
    let nats = [
        ("one", &*with_tls),
        ("two", with_password),
        ("three", with_another),
    ]
    .map(|(name, config)| {
        fs::create_dir(file(name)).unwrap();
        Nats::start_with(&file(name), 1, config)
    });
    let [tls, plain, another] = nats.each_ref().map(Nats::urls);
    let as_me = |urls: &str, password| urls.replace("//", &format!("//me:{password}@"));
    let [right, wrong] = ["right", "wrong"].map(|it| as_me(&plain, it));

    let start = |urls: &str, ca: &str, credentials: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
        command
            .current_dir(&directory)
            .args(["--grpc", "127.0.0.1:0", "--data", "memory"])
            .envs(member_settings(urls, 1))
            .env("WAYFOLD_CLUSTER__CA", ca)
            .env("WAYFOLD_CLUSTER__CREDENTIALS", credentials);
        Process::spawn(&mut command)
    };
    for (urls, ca, credentials) in [(&tls, "ca", "user"), (&right, "off", "off")] {
        let server = ServerProcess::ready(start(urls, ca, credentials));
        let mut stubs = Stubs::connect(server.uri()).await;
        stubs.create("arm", "R1").await;
        let written = insert_until_acknowledged(&mut stubs, 0..1);
        timeout(MAX_WAIT, written).await.unwrap();
    }
    // NATS is asked in a random order: some of them meet the server first that rejects them.
    let urls = format!("{right},{}", as_me(&another, "right"));
    for server in [(); 4].map(|()| start(&urls, "off", "off")) {
        ServerProcess::ready(server);
    }
    let refused = [
        (&tls, "other", "user", "UnknownIssuer; set cluster.ca"),
        (&tls, "none", "user", "error 2); set cluster.ca (now none)"),
        (&tls, "off", "user", "; set cluster.ca (now off)"),
        (&right, "ca", "off", "; set cluster.ca (now ca)"),
        (&tls, "ca", "off", NO_USER),
        (&tls, "ca", "stranger", NO_USER),
        (&tls, "ca", "none", "none (cluster.credentials): No such"),
        (&tls, "ca", "ca", "ca (cluster.credentials): cannot parse"),
        (&wrong, "off", "off", NO_USER),
        (&plain, "off", "off", NO_USER),
    ];
    // All of them run at once.
    let started = refused.map(|(urls, ca, user, error)| (start(urls, ca, user), error));
    for (server, error) in started {
        let ended = server.finish();
        assert_eq!(ended.status.code(), Some(1), "{}", ended.stderr);
        assert!(ended.stderr.contains(error), "{error}: {}", ended.stderr);
        assert!(!ended.stderr.contains("me:wrong"), "{}", ended.stderr);
    }
}
