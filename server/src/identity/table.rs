//! The file of identities.

use std::{
    collections::{BTreeMap, HashMap},
    fs, io,
    path::{Path, PathBuf},
    sync::{Arc, atomic::Ordering::Relaxed},
    time::{Duration, SystemTime},
};

use serde::Deserialize;
use sha2::{Digest as _, Sha256};
use subtle::ConstantTimeEq;
use thiserror::Error;
use time::{OffsetDateTime, format_description::well_known::Rfc3339};

use super::{Caller, ClientCertificate, Identity, Pattern, Role};
use crate::redact;

/// The SHA-256 of a token, in words, which are compared faster than bytes.
type Digest = [u64; 4];

/// The identities and their credentials.
#[derive(Debug, Default)]
pub(super) struct Table {
    tokens: Vec<(Digest, Arc<Identity>)>,
    certificates: HashMap<String, Arc<Identity>>,
    /// The entries by name, to tell which have changed.
    entries: BTreeMap<String, (Entry, Arc<Identity>)>,
}

/// The file of identities is wrong.
#[derive(Debug, Error)]
pub enum TableError {
    /// It cannot be read.
    #[error("cannot read the identities in {}: {source}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// The problem.
        source: io::Error,
    },
    /// It is no such file.
    #[error("the identities in {}: {problem}", file.display())]
    Syntax {
        /// The file.
        file: PathBuf,
        /// The problem and its place.
        problem: String,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default, rename = "identity")]
    identities: Vec<Entry>,
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    role: Role,
    indexes: Vec<String>,
    #[serde(default)]
    metrics: bool,
    token_sha256: Option<String>,
    certificate: Option<String>,
    expires: Option<String>,
    max_calls: Option<usize>,
    max_indexes: Option<usize>,
}

impl Table {
    /// Reads a file.
    pub(super) fn read(file: &Path) -> Result<Self, TableError> {
        let text = fs::read_to_string(file).map_err(|source| TableError::Read {
            file: file.to_owned(),
            source,
        })?;
        Self::parse(&text).map_err(|problem| TableError::Syntax {
            file: file.to_owned(),
            problem,
        })
    }

    fn parse(text: &str) -> Result<Self, String> {
        let parsed: File = toml::from_str(text).map_err(|error| redact::toml(&error, text))?;
        let mut table = Self::default();
        for entry in parsed.identities {
            let name = entry.name.clone();
            table
                .add(entry)
                .map_err(|problem| format!("identity {name:?}: {problem}"))?;
        }
        Ok(table)
    }

    fn add(&mut self, entry: Entry) -> Result<(), String> {
        if entry.name.is_empty() || self.entries.contains_key(&entry.name) {
            return Err("each needs a name of its own".into());
        }
        // A server of a cluster names the identity in a header, and log lines name it too.
        if entry.name.contains(char::is_control) {
            return Err("its name has a control character".into());
        }
        let expires = entry.expires.as_deref().map(instant).transpose()?;
        let identity = Arc::new(Identity {
            name: entry.name.clone(),
            role: entry.role,
            indexes: entry.indexes.iter().cloned().map(Pattern).collect(),
            reads_metrics: entry.metrics,
            expires,
            max_calls: entry.max_calls,
            max_indexes: entry.max_indexes,
            calls: 0.into(),
            is_revoked: false.into(),
        });
        match (&entry.token_sha256, &entry.certificate) {
            (Some(hex), None) => {
                let digest = digest_of_hex(hex)
                    .ok_or("token_sha256 is not the SHA-256 of a token, 64 hexadecimal digits")?;
                if self.tokens.iter().any(|(known, _)| *known == digest) {
                    return Err("another identity has its token".into());
                }
                self.tokens.push((digest, Arc::clone(&identity)));
            }
            (None, Some(subject)) => {
                let known = self
                    .certificates
                    .insert(subject.clone(), Arc::clone(&identity));
                if known.is_some() || subject.is_empty() {
                    return Err("it needs a certificate name of its own".into());
                }
            }
            _ => return Err("it needs either token_sha256 or certificate".into()),
        }
        self.entries.insert(entry.name.clone(), (entry, identity));
        Ok(())
    }

    /// Takes the place of `old`: the identities that are new or changed revoke those of the same name, and the others
    /// stay the same.
    pub(super) fn succeed(mut self, old: &Self) -> Self {
        let mut kept = Vec::new();
        for (name, (entry, identity)) in &old.entries {
            match self.entries.get_mut(name) {
                Some((same, new)) if same == entry => {
                    kept.push((Arc::clone(new), Arc::clone(identity)));
                    *new = Arc::clone(identity);
                }
                _ => identity.is_revoked.store(true, Relaxed),
            }
        }
        let credentials = self.tokens.iter_mut().map(|(_, identity)| identity);
        for identity in credentials.chain(self.certificates.values_mut()) {
            if let Some((_, old)) = kept.iter().find(|(new, _)| Arc::ptr_eq(new, identity)) {
                *identity = Arc::clone(old);
            }
        }
        self
    }

    /// The number of identities.
    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    /// The caller with this token. All digests are compared, each in constant time.
    pub(super) fn of_token(&self, token: &[u8]) -> Caller {
        let digest = digest(Sha256::digest(token).into());
        let mut found = None;
        for (known, identity) in &self.tokens {
            let pairs = known.iter().zip(digest);
            let difference = pairs.fold(0, |all, (known, word)| all | (known ^ word));
            if bool::from(difference.ct_eq(&0)) {
                found = Some(identity);
            }
        }
        Caller::of(found, None)
    }

    /// The caller of this name.
    pub(super) fn of_name(&self, name: &str) -> Caller {
        let found = self.entries.get(name).map(|(_, identity)| identity);
        Caller::of(found, None)
    }

    /// The caller whose verified client certificate is for any of its names.
    pub(super) fn of_certificate(&self, certificate: &ClientCertificate) -> Caller {
        let names = &mut certificate.names.iter();
        let found = names.find_map(|name| self.certificates.get(name));
        Caller::of(found, Some(certificate))
    }
}

fn digest(bytes: [u8; 32]) -> Digest {
    let (words, _) = bytes.as_chunks();
    std::array::from_fn(|at| u64::from_ne_bytes(words[at]))
}

fn digest_of_hex(text: &str) -> Option<Digest> {
    let mut bytes = [0; 32];
    hex::decode_to_slice(text, &mut bytes).ok()?;
    Some(digest(bytes))
}

fn instant(text: &str) -> Result<SystemTime, String> {
    let parsed = OffsetDateTime::parse(text, &Rfc3339);
    let parsed = parsed
        .map_err(|_| format!("expires = \"{text}\" is no time such as 2027-01-31T00:00:00Z"))?;
    let seconds = u64::try_from(parsed.unix_timestamp()).unwrap_or(0);
    Ok(SystemTime::UNIX_EPOCH + Duration::from_secs(seconds))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::identity::{Denial, IdentificationError};

    const TOKEN: &str = "wayfold_of_a_test";

    fn hex(token: &str) -> String {
        let digest = Sha256::digest(token.as_bytes());
        hex::encode(digest)
    }

    fn table(role: &str) -> Table {
        let text = format!(
            "[[identity]]\nname = \"cell\"\nrole = \"{role}\"\nindexes = [\"arm-*\"]\ntoken_sha256 = \"{}\"\n\
             [[identity]]\nname = \"gone\"\nrole = \"read\"\nindexes = [\"*\"]\ncertificate = \"gone.example\"\n\
             expires = \"1999-12-31T23:59:59+01:00\"\n",
            hex(TOKEN)
        );
        Table::parse(&text).unwrap()
    }

    /// A certificate that ends `hours` from now.
    fn certificate(names: &[&str], hours: i64) -> ClientCertificate {
        let ends = OffsetDateTime::now_utc() + time::Duration::hours(hours);
        ClientCertificate {
            names: names.iter().map(ToString::to_string).collect(),
            expires: ends.into(),
        }
    }

    #[test]
    fn the_rights_of_a_certificate_end_with_it() {
        let text = "[[identity]]\nname = \"cell\"\nrole = \"read\"\nindexes = []\ncertificate = \"cell\"\n";
        let table = Table::parse(text).unwrap();
        let check = |hours| table.of_certificate(&certificate(&["cell"], hours)).check();
        assert_eq!(check(1), Ok(()));
        assert_eq!(check(-1), Err(IdentificationError::Expired));
    }

    #[test]
    fn rights_end_at_the_role_the_pattern_and_the_expiry() {
        let table = table("write");
        let caller = table.of_token(TOKEN.as_bytes());
        caller.authorize(Role::Write, Some("arm-7")).unwrap();
        caller.authorize(Role::Read, None).unwrap();
        let admin = caller.authorize(Role::Admin, Some("arm-7")).unwrap_err();
        assert!(matches!(admin, Denial::Role { .. }));
        let leg = caller.authorize(Role::Read, Some("leg")).unwrap_err();
        assert!(matches!(leg, Denial::Index { .. }));
        let expired = table.of_certificate(&certificate(&["other", "gone.example"], 1));
        assert_eq!(expired.check(), Err(IdentificationError::Expired));
        for caller in [
            table.of_token(b"another"),
            table.of_certificate(&certificate(&["other"], 1)),
        ] {
            assert_eq!(caller.check(), Err(IdentificationError::WrongCredential));
        }
    }

    #[test]
    fn a_quota_of_calls_counts_those_under_way() {
        let text = format!(
            "[[identity]]\nname = \"cell\"\nrole = \"read\"\nindexes = [\"*\"]\nmax_calls = 2\ntoken_sha256 = \"{}\"\n",
            hex(TOKEN)
        );
        let table = Table::parse(&text).unwrap();
        let call = || table.of_token(TOKEN.as_bytes());
        let (first, second, third) = (call(), call(), call());
        second.check().unwrap();
        assert_eq!(third.check(), Err(IdentificationError::TooManyCalls(2)));
        // A clone belongs to the same call.
        let same = first.clone();
        drop((first, third));
        assert_eq!(call().check(), Err(IdentificationError::TooManyCalls(2)));
        drop(same);
        call().check().unwrap();
    }

    #[test]
    fn an_identity_that_changes_is_revoked_and_another_stays() {
        let old = table("write");
        let before = old.of_token(TOKEN.as_bytes());
        let same = table("write").succeed(&old);
        let again = same.of_token(TOKEN.as_bytes());
        before.check().unwrap();
        again.check().unwrap();
        let changed = table("read").succeed(&same);
        for caller in [before, again] {
            assert_eq!(caller.check(), Err(IdentificationError::Revoked));
        }
        changed.of_token(TOKEN.as_bytes()).check().unwrap();
    }

    #[test]
    fn an_error_names_the_place_without_the_line() {
        let entry = |rest: &str| format!("[[identity]]\nname = \"cell\"\n{rest}");
        for (text, part) in [
            (entry("role = \"root\""), "line 3"),
            (
                "[[identity]]\nname = \"a\\nb\"\nrole = \"read\"\nindexes = []\n".to_owned(),
                "control character",
            ),
            (
                entry("role = \"read\"\ntoken = \"s3cret\""),
                "unknown field `token`",
            ),
            (entry("token_sha256 = \"a\"s3cret"), "line 3, column 19: "),
            (
                entry("role = \"s3cret\""),
                "line 3, column 8: unknown variant, expected one of `read`",
            ),
            (
                entry("max_calls = \"s3cret\""),
                "line 3, column 13: invalid type, expected usize",
            ),
            (
                entry("role = \"read\"\nindexes = \"s3cret, expected \""),
                "invalid type, expected a sequence",
            ),
            (
                entry("role = \"read\"\nindexes = []"),
                "either token_sha256 or certificate",
            ),
            (
                entry("role = \"read\"\nindexes = []\ntoken_sha256 = \"s3cret\""),
                "64 hexadecimal digits",
            ),
            (
                entry("role = \"read\"\nindexes = []\ncertificate = \"a\"\nexpires = \"soon\""),
                "2027-01-31",
            ),
        ] {
            let problem = Table::parse(&text).unwrap_err();
            assert!(problem.contains(part), "{problem}");
            assert!(!problem.contains("s3cret"), "{problem}");
        }
    }
}
