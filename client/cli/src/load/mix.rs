//! The verbs of a load, and the shares that they have in it.

use std::fmt;

/// A call that the load makes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verb {
    Insert,
    Knn,
    Query,
    Get,
    /// knn over one stream, with a request for each state.
    Stream,
}

impl Verb {
    pub(super) const ALL: [Verb; 5] = [
        Verb::Insert,
        Verb::Knn,
        Verb::Query,
        Verb::Get,
        Verb::Stream,
    ];

    pub(super) fn name(self) -> &'static str {
        match self {
            Verb::Insert => "insert",
            Verb::Knn => "knn",
            Verb::Query => "query",
            Verb::Get => "get",
            Verb::Stream => "stream",
        }
    }

    fn of_name(name: &str) -> Option<Verb> {
        Verb::ALL.into_iter().find(|verb| verb.name() == name)
    }
}

/// The weights of the verbs, in the order of [`Verb::ALL`]. One at least is above 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Mix([u32; Verb::ALL.len()]);

impl Default for Mix {
    /// A planner's calls: it searches far more often than it inserts.
    fn default() -> Mix {
        Mix([1, 8, 1, 1, 0])
    }
}

/// A weight has at most this value, so that no sum overflows.
const MAX_WEIGHT: u32 = 1_000_000;

impl Mix {
    /// The weights of `insert=1,knn=8`. A verb that is not named has none.
    pub(super) fn parse(text: &str) -> Result<Mix, String> {
        let mut weights = [None; Verb::ALL.len()];
        for part in text.split(',') {
            let (name, weight) = match part.split_once('=') {
                Some((name, weight)) => (name.trim(), Some(weight.trim())),
                None => (part.trim(), None),
            };
            let verb = Verb::of_name(name).ok_or_else(|| unknown_verb(name))?;
            let weight = weight.ok_or_else(|| {
                format!("{name} has no weight: write {name}=1, or another whole number")
            })?;
            let number = weight.parse().ok().filter(|number| *number <= MAX_WEIGHT);
            let number = number.ok_or_else(|| {
                format!("{weight:?} is not a weight of {name}: expected a whole number up to {MAX_WEIGHT}")
            })?;
            let slot = &mut weights[verb as usize];
            if slot.replace(number).is_some() {
                return Err(format!("{name} is given twice"));
            }
        }
        let mix = Mix(weights.map(Option::unwrap_or_default));
        match mix.total() {
            0 => Err("every weight is 0: give one verb at least a weight above 0".to_owned()),
            _ => Ok(mix),
        }
    }

    /// The sum of the weights.
    pub(super) fn total(&self) -> u32 {
        self.0.iter().sum()
    }

    pub(super) fn has(&self, verb: Verb) -> bool {
        self.0[verb as usize] > 0
    }

    /// The verb at a place from 0 to the sum of the weights.
    pub(super) fn verb(&self, mut place: u32) -> Verb {
        let weighted = Verb::ALL.into_iter().zip(self.0);
        for (verb, weight) in weighted {
            match place.checked_sub(weight) {
                Some(rest) => place = rest,
                None => return verb,
            }
        }
        Verb::Knn
    }
}

fn unknown_verb(name: &str) -> String {
    let names = Verb::ALL.map(Verb::name).join(", ");
    format!("{name:?} is not a verb of a load; the verbs are {names}")
}

impl fmt::Display for Mix {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let weighted = Verb::ALL.into_iter().zip(self.0);
        let named = weighted.filter(|(_, weight)| *weight > 0);
        for (i, (verb, weight)) in named.enumerate() {
            let comma = if i == 0 { "" } else { "," };
            write!(f, "{comma}{}={weight}", verb.name())?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mix_reads_back_as_itself() {
        for text in [
            "insert=1,knn=8,query=1,get=1",
            "knn=1",
            "insert=3,get=1000000",
        ] {
            assert_eq!(Mix::parse(text).unwrap().to_string(), text);
        }
        assert_eq!(
            Mix::parse(" get = 2 , insert=0 ").unwrap().to_string(),
            "get=2"
        );
        assert_eq!(Mix::parse(&Mix::default().to_string()), Ok(Mix::default()));
    }

    #[test]
    fn a_wrong_mix_says_what_to_write() {
        for (text, expected) in [
            ("knn", "knn has no weight: write knn=1"),
            ("kn=1", "the verbs are insert, knn"),
            ("update=1", "the verbs are insert, knn, query, get, stream"),
            ("", "\"\" is not a verb"),
            ("knn=1,", "\"\" is not a verb"),
            ("knn=1,knn=2", "knn is given twice"),
            ("knn=0,get=0", "every weight is 0"),
            ("knn=-1", "\"-1\" is not a weight of knn"),
            ("knn=0.5", "expected a whole number"),
            ("knn=1000001", "up to 1000000"),
            ("knn=", "\"\" is not a weight"),
        ] {
            let error = Mix::parse(text).unwrap_err();
            assert!(error.contains(expected), "{text:?}: {error}");
        }
    }

    #[test]
    fn each_verb_has_as_many_places_as_its_weight() {
        let mix = Mix::parse("insert=1,knn=3,get=2").unwrap();
        let places: Vec<_> = (0..mix.total()).map(|place| mix.verb(place)).collect();
        use Verb::{Get, Insert, Knn};
        assert_eq!(places, [Insert, Knn, Knn, Knn, Get, Get]);
    }
}
