//! The verbs of the service by name, for faces without generated stubs: Zenoh and the operators' listener.
//!
//! A key (`verb`) names an index and a verb. A request (`request`) has parameters and a payload in Protocol Buffers or
//! JSON (`codec`), and is translated to a call of the service and back (`dispatch`). No policy is here.

mod codec;
mod dispatch;
mod request;
mod verb;

pub(crate) use codec::{Form, MAX_DYNAMIC_BYTES, invalid};
pub(crate) use dispatch::dispatch;
pub(crate) use request::{MAX_TIMEOUT, Request, at_length};
pub(crate) use verb::{Target, Verb};
