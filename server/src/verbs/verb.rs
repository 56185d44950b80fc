//! The verbs, and their keys.

use super::codec::invalid;
use crate::service::Error;

/// A verb.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verb {
    Knn,
    Query,
    Insert,
    Update,
    Remove,
    Session,
    Write,
    Get,
    Scan,
    Info,
    Log,
    Server,
    Create,
    List,
    Delete,
}

impl Verb {
    /// The verbs of one index: `<prefix>/<index>/<verb>`.
    pub(crate) const OF_INDEX: [(&str, Self); 11] = [
        ("knn", Self::Knn),
        ("query", Self::Query),
        ("insert", Self::Insert),
        ("update", Self::Update),
        ("remove", Self::Remove),
        ("session", Self::Session),
        ("write", Self::Write),
        ("get", Self::Get),
        ("scan", Self::Scan),
        ("info", Self::Info),
        ("log", Self::Log),
    ];

    /// The verbs of the server: `<prefix>/<verb>`.
    pub(crate) const OF_SERVER: [(&str, Self); 4] = [
        ("server", Self::Server),
        ("create", Self::Create),
        ("list", Self::List),
        ("delete", Self::Delete),
    ];

    /// True if it may change something. It needs a payload then, so that a key alone changes nothing.
    pub(crate) fn is_mutation(self) -> bool {
        match self {
            Self::Insert
            | Self::Update
            | Self::Remove
            | Self::Session
            | Self::Write
            | Self::Create
            | Self::Delete => true,
            Self::Knn
            | Self::Query
            | Self::Get
            | Self::Scan
            | Self::Info
            | Self::Log
            | Self::Server
            | Self::List => false,
        }
    }

    /// True if it searches for neighbours.
    pub(crate) fn is_search(self) -> bool {
        matches!(self, Self::Knn | Self::Query)
    }

    /// True if it is a verb of the server: its key names no index.
    pub(crate) fn is_of_server(self) -> bool {
        Self::OF_SERVER.iter().any(|(_, verb)| *verb == self)
    }

    /// Its name in the key.
    pub(crate) fn name(self) -> &'static str {
        let mut all = Self::OF_INDEX.iter().chain(&Self::OF_SERVER);
        all.find(|(_, verb)| *verb == self)
            .map_or("", |(name, _)| name)
    }
}

/// A parsed key without wildcards.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Target<'a> {
    /// The index; empty for a verb of the server.
    pub(crate) index: &'a str,
    pub(crate) verb: Verb,
}

impl<'a> Target<'a> {
    /// Parses a key under `prefix`.
    pub(crate) fn of(prefix: &str, key: &'a str) -> Result<Self, Error> {
        Self::find(prefix, key).ok_or_else(|| unknown(prefix, key, |_| true))
    }

    /// Parses a key of a face that only reads: its error names no mutation.
    pub(crate) fn of_reader(prefix: &str, key: &'a str) -> Result<Self, Error> {
        Self::find(prefix, key).ok_or_else(|| unknown(prefix, key, |verb| !verb.is_mutation()))
    }

    fn find(prefix: &str, key: &'a str) -> Option<Self> {
        let rest = key.strip_prefix(prefix).unwrap_or_default();
        let rest = rest.strip_prefix('/').unwrap_or_default();
        let (index, name, all) = match rest.split_once('/') {
            Some((index, name)) => (index, name, &Verb::OF_INDEX[..]),
            None => ("", rest, &Verb::OF_SERVER[..]),
        };
        let &(_, verb) = all.iter().find(|(known, _)| *known == name)?;
        Some(Self { index, verb })
    }
}

fn unknown(prefix: &str, key: &str, is_offered: fn(Verb) -> bool) -> Error {
    let names = |all: &[(&'static str, Verb)]| {
        let offered = all.iter().filter(|(_, verb)| is_offered(*verb));
        offered
            .map(|(name, _)| *name)
            .collect::<Vec<_>>()
            .join(", ")
    };
    let text = format!(
        "no verb has the key {key}: under {prefix}/INDEX/ there are {}, and under {prefix}/ {}",
        names(&Verb::OF_INDEX),
        names(&Verb::OF_SERVER),
    );
    invalid("key", "UNKNOWN_KEY", text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_taken_apart() {
        let key = |text: &'static str| {
            let target = Target::of("wayfold/v1", text);
            target.map(|target| (target.index, target.verb)).ok()
        };
        assert_eq!(key("wayfold/v1/arm/knn"), Some(("arm", Verb::Knn)));
        assert_eq!(key("wayfold/v1/list/knn"), Some(("list", Verb::Knn)));
        assert_eq!(key("wayfold/v1/list"), Some(("", Verb::List)));
        assert_eq!(key("wayfold/v1/server"), Some(("", Verb::Server)));
        for other in [
            "wayfold/v1",
            "wayfold/v1/arm/server",
            "wayfold/v1/arm",
            "wayfold/v1/knn",
            "wayfold/v1/arm/list",
            "wayfold/v1/arm/events",
            "wayfold/v1/arm/knn/more",
            "wayfold/v12/list",
            "another",
        ] {
            assert_eq!(key(other), None, "{other}");
        }
    }

    #[test]
    fn verbs_have_names_of_their_own() {
        for (name, verb) in Verb::OF_INDEX.into_iter().chain(Verb::OF_SERVER) {
            assert_eq!(verb.name(), name);
        }
    }
}
