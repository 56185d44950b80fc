//! Reads the text form by recursive descent, and checks its size before it allocates.

use crate::space::{Factor, Group, Space, SpaceError, Term, is_weight, presets, so2};

/// The greatest depth of nested parentheses. The printed form needs eight: each level repeats, and there are 256
/// coordinates.
const MAX_DEPTH: usize = 32;

/// Reads a whole space.
pub(in crate::space) fn parse(text: &str) -> Result<Space, SpaceError> {
    if let Some(preset) = presets::named(text.trim()) {
        return preset;
    }
    let mut parser = Parser { text, at: 0 };
    let (groups, more) = if parser.word() == "sum" {
        (parser.sum()?, "the end: a sum stands outermost and alone")
    } else {
        let terms = flatten(&parser.product(0)?)?;
        (vec![Group { weight: 1.0, terms }], "* or the end")
    };
    if parser.peek().is_some() {
        return Err(parser.expected(more));
    }
    Space::new(groups)
}

/// One item of a product: `terms:weight^count`.
struct Item {
    terms: Vec<Term>,
    weight: f64,
    count: usize,
}

/// The tokens read so far.
struct Parser<'a> {
    text: &'a str,
    /// The next byte.
    at: usize,
}

impl<'a> Parser<'a> {
    fn sum(&mut self) -> Result<Vec<Group>, SpaceError> {
        self.at += self.word().len();
        self.require('(', "( after sum")?;
        let (mut groups, mut coordinates) = (Vec::new(), 0);
        loop {
            let items = self.product(0)?;
            let (group, count) = match <[Item; 1]>::try_from(items) {
                Ok(
                    [
                        Item {
                            terms,
                            weight,
                            count,
                        },
                    ],
                ) => (Group { weight, terms }, count),
                Err(items) => {
                    let terms = flatten(&items)?;
                    (Group { weight: 1.0, terms }, 1)
                }
            };
            coordinates = grown(coordinates, &group.terms, count)?;
            groups.extend(std::iter::repeat_n(group, count));
            if !self.eat(',') {
                break;
            }
        }
        self.require(')', "*, a comma or ) in the sum")?;
        Ok(groups)
    }

    fn product(&mut self, depth: usize) -> Result<Vec<Item>, SpaceError> {
        let mut items = vec![self.item(depth)?];
        while self.eat('*') {
            // Each item has at least one coordinate.
            if items.len() == Space::MAX_COORDINATES {
                return Err(SpaceError::TooManyCoordinates);
            }
            items.push(self.item(depth)?);
        }
        Ok(items)
    }

    fn item(&mut self, depth: usize) -> Result<Item, SpaceError> {
        let terms = if self.peek() == Some('(') {
            if depth == MAX_DEPTH {
                return Err(self.expected("parentheses that nest at most 32 deep"));
            }
            self.eat('(');
            let terms = flatten(&self.product(depth + 1)?)?;
            self.require(')', "* or ) in the parentheses")?;
            terms
        } else {
            vec![self.factor()?.into()]
        };
        let weight = if self.eat(':') {
            self.number("a weight, finite and at least 0", is_weight)?
        } else {
            1.0
        };
        let count = if self.eat('^') { self.count()? } else { 1 };
        if self.peek() == Some(':') {
            return Err(self.expected("one weight, and before the count, as in R3:2^4"));
        }
        Ok(Item {
            terms,
            weight,
            count,
        })
    }

    fn factor(&mut self) -> Result<Factor, SpaceError> {
        let word = self.word();
        let factor = match word {
            "SO2" | "S1" => Factor::so2(),
            "SO3" | "RP3" => Factor::SO3,
            "sum" => {
                return Err(self.expected(
                    "a factor or a product: a sum stands outermost and alone, nothing deeper is accepted",
                ));
            }
            _ => match word.strip_prefix('R').map(|n| (n, n.parse())) {
                Some((_, Ok(0))) => return Err(self.expected("a dimension of at least 1 after R")),
                Some((_, Ok(n))) => Factor::RealVector(n),
                // Digits that do not fit a number are more than fit a space.
                Some((n, Err(_))) if !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()) => {
                    return Err(SpaceError::TooManyCoordinates);
                }
                Some(("", Err(_))) => return Err(self.expected("a dimension after R, as in R3")),
                Some((_, Err(_))) | None => {
                    return Err(self.expected(
                        "a factor (R3, SO2, SO2[1], SO3) or a product in parentheses; \
                         a sum or the name of a preset stands alone",
                    ));
                }
            },
        };
        self.at += word.len();
        match factor {
            Factor::SO2 { .. } if self.eat('[') => {
                let period = self.number("a period from 1e-150 to 1e150", so2::is_period)?;
                self.require(']', "] after the period")?;
                Ok(Factor::SO2 { period })
            }
            Factor::RealVector(_) | Factor::SO2 { .. } | Factor::SO3 => Ok(factor),
        }
    }

    /// Reads a number that `accepted` holds for.
    fn number(&mut self, what: &str, accepted: fn(f64) -> bool) -> Result<f64, SpaceError> {
        self.peek();
        let digits = self.numeral();
        match digits.parse() {
            Ok(number) if accepted(number) => {
                self.at += digits.len();
                Ok(number)
            }
            Ok(_) | Err(_) => Err(self.expected(what)),
        }
    }

    fn count(&mut self) -> Result<usize, SpaceError> {
        self.peek();
        let digits = self.numeral();
        match digits.parse() {
            Ok(count) if (1..=Space::MAX_COORDINATES).contains(&count) => {
                self.at += digits.len();
                Ok(count)
            }
            Ok(_) | Err(_) => Err(self.expected("a count from 1 to 256")),
        }
    }

    fn require(&mut self, token: char, what: &str) -> Result<(), SpaceError> {
        if self.eat(token) {
            Ok(())
        } else {
            Err(self.expected(what))
        }
    }

    fn eat(&mut self, token: char) -> bool {
        let found = self.peek() == Some(token);
        if found {
            self.at += token.len_utf8();
        }
        found
    }

    /// Skips white space; the next character is returned and stays.
    fn peek(&mut self) -> Option<char> {
        let rest = self.rest();
        self.at += rest.len() - rest.trim_start().len();
        self.rest().chars().next()
    }

    /// The letters, digits, - and _ that come next, which stay.
    fn word(&mut self) -> &'a str {
        self.peek();
        let rest = self.rest();
        let end = rest.find(|c: char| !(c.is_ascii_alphanumeric() || c == '-' || c == '_'));
        &rest[..end.unwrap_or(rest.len())]
    }

    /// The characters that come next and look like a number; they stay. A sign counts at the start and after an e.
    fn numeral(&self) -> &'a str {
        let rest = self.rest();
        let mut before = 'e';
        let end = rest.find(|c: char| {
            let sign = matches!(c, '+' | '-') && matches!(before, 'e' | 'E');
            before = c;
            !(c.is_ascii_alphanumeric() || c == '.' || sign)
        });
        &rest[..end.unwrap_or(rest.len())]
    }

    fn rest(&self) -> &'a str {
        &self.text[self.at..]
    }

    /// The error of an unexpected token.
    fn expected(&mut self, expected: &str) -> SpaceError {
        let found = match (self.peek(), self.numeral(), self.word()) {
            (None, _, _) => "the end".to_owned(),
            (Some(c), "", "") => format!("\"{c}\""),
            (Some(_), numeral, word) => {
                let longer = if numeral.len() > word.len() {
                    numeral
                } else {
                    word
                };
                format!("\"{}\"", clipped(longer))
            }
        };
        SpaceError::Syntax {
            text: clipped(self.text),
            column: self.text[..self.at].chars().count() + 1,
            expected: expected.to_owned(),
            found,
        }
    }
}

/// The terms of a product's items, each item's weight multiplied in and repeated as often as it says.
fn flatten(items: &[Item]) -> Result<Vec<Term>, SpaceError> {
    let (mut terms, mut coordinates) = (Vec::new(), 0);
    for item in items {
        coordinates = grown(coordinates, &item.terms, item.count)?;
        for _ in 0..item.count {
            terms.extend(item.terms.iter().map(|term| Term {
                factor: term.factor,
                weight: term.weight * item.weight,
            }));
        }
    }
    Ok(terms)
}

/// `coordinates` and those of `terms`, `count` times: checked before they are made.
fn grown(coordinates: usize, terms: &[Term], count: usize) -> Result<usize, SpaceError> {
    let once = terms.iter().fold(0_usize, |sum, term| {
        sum.saturating_add(term.factor.coordinates())
    });
    let all = once.saturating_mul(count).saturating_add(coordinates);
    if all > Space::MAX_COORDINATES {
        return Err(SpaceError::TooManyCoordinates);
    }
    Ok(all)
}

/// The first 60 characters of a text, for a message of one line.
fn clipped(text: &str) -> String {
    const LENGTH: usize = 60;
    let mut short: String = text.chars().take(LENGTH).collect();
    if short.len() < text.len() {
        short.push('…');
    }
    short.replace(|c: char| c.is_control(), " ")
}
