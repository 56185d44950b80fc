//! The verbs, and their keys.

use super::codec::invalid;
use crate::service::Error;

/// A verb of one index: `<prefix>/<index>/<verb>`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PointVerb {
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
}

/// A verb of the server: `<prefix>/<verb>`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum IndexVerb {
    Server,
    Create,
    List,
    Delete,
}

/// A verb.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verb {
    OfIndex(PointVerb),
    OfServer(IndexVerb),
}

impl PointVerb {
    pub(crate) const ALL: [(&str, Self); 11] = [
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
}

impl IndexVerb {
    pub(crate) const ALL: [(&str, Self); 4] = [
        ("server", Self::Server),
        ("create", Self::Create),
        ("list", Self::List),
        ("delete", Self::Delete),
    ];
}

impl Verb {
    /// True if it may change something. It needs a payload then, so that a key alone changes nothing.
    pub(crate) fn is_mutation(self) -> bool {
        match self {
            Verb::OfIndex(verb) => match verb {
                PointVerb::Insert
                | PointVerb::Update
                | PointVerb::Remove
                | PointVerb::Session
                | PointVerb::Write => true,
                PointVerb::Knn
                | PointVerb::Query
                | PointVerb::Get
                | PointVerb::Scan
                | PointVerb::Info
                | PointVerb::Log => false,
            },
            Verb::OfServer(verb) => match verb {
                IndexVerb::Create | IndexVerb::Delete => true,
                IndexVerb::Server | IndexVerb::List => false,
            },
        }
    }

    /// True if it searches for neighbours.
    pub(crate) fn is_search(self) -> bool {
        matches!(self, Verb::OfIndex(PointVerb::Knn | PointVerb::Query))
    }

    /// Its name in the key.
    pub(crate) fn name(self) -> &'static str {
        let name = match self {
            Verb::OfIndex(verb) => PointVerb::ALL.iter().find(|(_, v)| *v == verb).map(|v| v.0),
            Verb::OfServer(verb) => IndexVerb::ALL.iter().find(|(_, v)| *v == verb).map(|v| v.0),
        };
        name.unwrap_or_default()
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
        let known = |(index, verb): (&'a str, &str)| {
            let found = PointVerb::ALL.iter().find(|(name, _)| *name == verb)?;
            Some((index, Verb::OfIndex(found.1)))
        };
        let of_server = || {
            let found = IndexVerb::ALL.iter().find(|(name, _)| *name == rest)?;
            Some(("", Verb::OfServer(found.1)))
        };
        let (index, verb) = rest.split_once('/').map_or_else(of_server, known)?;
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
        names(&PointVerb::ALL.map(|(name, verb)| (name, Verb::OfIndex(verb)))),
        names(&IndexVerb::ALL.map(|(name, verb)| (name, Verb::OfServer(verb)))),
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
        let knn = Verb::OfIndex(PointVerb::Knn);
        assert_eq!(key("wayfold/v1/arm/knn"), Some(("arm", knn)));
        assert_eq!(key("wayfold/v1/list/knn"), Some(("list", knn)));
        let list = Verb::OfServer(IndexVerb::List);
        assert_eq!(key("wayfold/v1/list"), Some(("", list)));
        let server = Verb::OfServer(IndexVerb::Server);
        assert_eq!(key("wayfold/v1/server"), Some(("", server)));
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
        let of_index = PointVerb::ALL.map(|(name, verb)| (name, Verb::OfIndex(verb)));
        let of_server = IndexVerb::ALL.map(|(name, verb)| (name, Verb::OfServer(verb)));
        for (name, verb) in of_index.into_iter().chain(of_server) {
            assert_eq!(verb.name(), name);
        }
    }
}
