//! The index, parameters, payload and form of one request.

use std::{
    borrow::Cow,
    time::{Duration, Instant},
};

use prost::Name;

use super::{
    codec::{Form, MAX_DYNAMIC_BYTES, invalid},
    verb::Verb,
};
use crate::{
    observe,
    request_bounds::{MAX_INDEX_REQUEST_BYTES, SMALL_SPACE, check_fields},
    service::{Error, Limits},
};

/// The parameter for the time that the caller waits.
const TIMEOUT: &str = "timeout_ms";

/// The longest time that a caller waits; a longer one counts as this. A caller may leave without a word, and its call keeps
/// its place until the deadline.
pub(crate) const MAX_TIMEOUT: Duration = Duration::from_secs(60);

/// A larger message is encoded and decoded as blocking work. Well above the bytes answered on Zenoh's own threads.
const MAX_INLINE_BYTES: usize = 64 * 1024;

/// See the module.
pub(crate) struct Request<'a> {
    /// The form of the request and of its answer.
    pub(crate) form: Form,
    /// The index that the key names.
    index: &'a str,
    parameters: Vec<(&'a str, &'a str)>,
    payload: Cow<'a, [u8]>,
}

impl<'a> Request<'a> {
    /// A request for `index` that arrived at `arrived`, and the deadline that a parameter sets.
    pub(crate) fn of(
        form: Form,
        index: &'a str,
        named: impl IntoIterator<Item = (&'a str, &'a str)>,
        payload: Cow<'a, [u8]>,
        arrived: Instant,
    ) -> Result<(Self, Option<Instant>), Error> {
        let mut deadline = None;
        let mut parameters = Vec::new();
        for (name, value) in named {
            if name == TIMEOUT {
                let read = read_timeout(value, arrived)?;
                if deadline.is_some_and(|before| before != read) {
                    let text = "it is given twice, and not the same";
                    return Err(invalid(TIMEOUT, "CONFLICT", text));
                }
                deadline = Some(read);
            } else if !name.starts_with('_') {
                // Zenoh's own parameters begin with an underscore.
                parameters.push((name, value));
            }
        }
        let request = Self {
            form,
            index,
            parameters,
            payload,
        };
        Ok((request, deadline))
    }

    /// Refuses a mutation without a payload, and a payload above [`MAX_DYNAMIC_BYTES`] beside parameters.
    pub(crate) fn check(&self, verb: Verb) -> Result<(), Error> {
        if verb.is_mutation() && self.payload.is_empty() {
            let text = format!("{} needs a payload, at least {{}}", verb.name());
            return Err(invalid("payload", "REQUIRED", text));
        }
        if self.payload.len() > MAX_DYNAMIC_BYTES && !self.parameters.is_empty() {
            let text = format!(
                "it has {} bytes beside parameters, more than {MAX_DYNAMIC_BYTES}: set their fields in the payload",
                self.payload.len()
            );
            return Err(invalid("payload", "TOO_LONG_WITH_PARAMETERS", text));
        }
        Ok(())
    }

    /// Refuses a payload that would grow too much by decoding.
    pub(super) fn check_growth(&self, verb: Verb, limits: &Limits) -> Result<(), Error> {
        match self.form {
            _ if verb.is_of_server() && self.payload.len() > MAX_INDEX_REQUEST_BYTES => {
                Err(Error::LimitExceeded {
                    limit: "index_request_bytes",
                    value: MAX_INDEX_REQUEST_BYTES as u64,
                    requested: self.payload.len() as u64,
                    advice: SMALL_SPACE,
                })
            }
            Form::Protobuf => check_fields(&self.payload, verb == Verb::Write, limits),
            Form::Json => Ok(()),
        }
    }

    /// Decodes the request for the index that the key names.
    pub(crate) fn decode_for_index<R>(&self) -> Result<R, Error>
    where
        R: Name + Default + observe::Request,
    {
        let mut request: R = self.decode()?;
        match request.index_mut() {
            Some(index) if index.is_empty() => index.push_str(self.index),
            Some(index) if index != self.index => {
                let text = format!("the payload names {index:?}, the key {:?}", self.index);
                return Err(invalid("index_name", "CONFLICT", text));
            }
            _ => {}
        }
        observe::request(&request);
        Ok(request)
    }

    /// Decodes the request if the key names no index.
    pub(crate) fn decode<R: Name + Default>(&self) -> Result<R, Error> {
        let read = || self.form.read(&self.payload, &self.parameters);
        let parameters = self.parameters.iter().map(|(_, value)| value.len());
        at_length(self.payload.len() + parameters.sum::<usize>(), read)
    }

    /// Encodes an answer in the form of the request.
    pub(super) fn encode<M: Name>(&self, answer: Result<M, Error>) -> Result<Vec<u8>, Error> {
        let answer = answer?;
        at_length(answer.encoded_len(), || self.form.write(&answer))
    }
}

/// Encodes or decodes this many bytes. Large JSON takes long: other tasks move to another thread meanwhile.
pub(crate) fn at_length<T>(bytes: usize, work: impl FnOnce() -> T) -> T {
    if bytes > MAX_INLINE_BYTES {
        tokio::task::block_in_place(work)
    } else {
        work()
    }
}

fn read_timeout(text: &str, arrived: Instant) -> Result<Instant, Error> {
    let timeout = text.parse().map_err(|_| {
        let text = format!("{text:?} is not a number of milliseconds");
        invalid(TIMEOUT, "MALFORMED_TIMEOUT", text)
    })?;
    Ok(arrived + Duration::from_millis(timeout).min(MAX_TIMEOUT))
}

#[cfg(test)]
mod tests;
