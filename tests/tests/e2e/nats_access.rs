//! NATS with TLS and users: a server works with the right settings, and with a wrong one it ends and names the setting.
//! The environment variable `NATS_SERVER` has the path of the program nats-server.

use std::{fs, process::Command};

use rcgen::{CertificateParams, DnType, KeyPair, PKCS_ED25519, SigningKey};
use serde_json::json;
use tokio::time::timeout;
use wayfold_tests::{
    Process, ServerProcess, Stubs,
    nats::{Nats, member_settings},
};

use crate::journal_loss::{MAX_WAIT, insert_until_acknowledged};

const BASE32: &[u8] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZ234567";
const BASE64: &[u8] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";

/// A key as NATS writes it: the letter of its role, `O`perator, `A`ccount or `U`ser, as five bits, and an Ed25519 pair.
struct Nkey(u8, KeyPair);

impl Nkey {
    fn new(role: u8) -> Self {
        let pair = KeyPair::generate_for(&PKCS_ED25519);
        Self(role - b'A', pair.unwrap())
    }

    fn public(&self) -> String {
        with_checksum(&[self.0 << 3], self.1.public_key_raw())
    }

    fn seed(&self) -> String {
        // In PKCS#8 the seed follows a header of 16 bytes.
        let seed = &self.1.serialized_der()[16..48];
        with_checksum(&[((b'S' - b'A') << 3) | (self.0 >> 2), self.0 << 6], seed)
    }

    /// The token by which this key admits another one. An account that may store no byte has no JetStream.
    fn admit(&self, other: &Self, kind: &str, bytes: i64) -> String {
        // A missing limit would be 0; -1 is no limit.
        let claims = json!({ "iss": self.public(), "sub": other.public(), "nats": {
            "type": kind, "version": 2, "subs": -1, "payload": -1, "limits": {
                "subs": -1, "payload": -1, "conn": -1, "streams": -1, "consumer": -1,
                "mem_storage": bytes, "disk_storage": bytes,
            },
        } });
        let header = json!({ "typ": "JWT", "alg": "ed25519-nkey" });
        let signed = [header, claims].map(|it| encode(it.to_string().as_bytes(), BASE64, 6));
        let signed = signed.join(".");
        let signature = self.1.sign(signed.as_bytes()).unwrap();
        format!("{signed}.{}", encode(&signature, BASE64, 6))
    }
}

/// A key in base32 and its checksum, CRC-16/XMODEM.
fn with_checksum(prefix: &[u8], key: &[u8]) -> String {
    let mut bytes = [prefix, key].concat();
    let shift = |sum: u16| (sum << 1) ^ if sum & 0x8000 == 0 { 0 } else { 0x1021 };
    let sum = bytes.iter().fold(0_u16, |sum, byte| {
        (0..8).fold(sum ^ (u16::from(*byte) << 8), |sum, _| shift(sum))
    });
    bytes.extend(sum.to_le_bytes());
    encode(&bytes, BASE32, 5)
}

/// Bytes in base32 or base64, whose letters have this many bits, without padding.
fn encode(bytes: &[u8], alphabet: &[u8], bits: usize) -> String {
    let of_byte = |byte: &u8| [7, 6, 5, 4, 3, 2, 1, 0].map(|bit| (*byte >> bit) & 1);
    let all: Vec<u8> = bytes.iter().flat_map(of_byte).collect();
    let letter = |part: &[u8]| {
        let value = part.iter().fold(0_u8, |value, bit| (value << 1) | bit);
        char::from(alphabet[usize::from(value << (bits - part.len()))])
    };
    all.chunks(bits).map(letter).collect()
}

/// The configuration of an operator with an account, and the credentials of a user of the account.
fn operator() -> (String, String) {
    let [operator, system, account, user] = [b'O', b'A', b'A', b'U'].map(Nkey::new);
    // Under an operator JetStream needs a system account.
    let config = format!(
        "operator: {0}\nsystem_account: {1}\nresolver: MEMORY\nresolver_preload {{\n{1}: {2}\n{3}: {4}\n}}",
        operator.admit(&operator, "operator", 0),
        system.public(),
        operator.admit(&system, "account", 0),
        account.public(),
        operator.admit(&account, "account", -1),
    );
    let credentials = format!(
        "-----BEGIN NATS USER JWT-----\n{}\n------END NATS USER JWT------\n\n\
         -----BEGIN USER NKEY SEED-----\n{}\n------END USER NKEY SEED------\n",
        account.admit(&user, "user", 0),
        user.seed(),
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
