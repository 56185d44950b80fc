//! `wayfold health`

use serde::Serialize;

use crate::{Session, failure::Failure, output::Format};

#[derive(Serialize)]
struct HealthLine<'a> {
    server: &'a str,
    serving: bool,
}

pub(crate) async fn health(session: &mut Session) -> Result<(), Failure> {
    let serving = session.client.is_serving().await?;
    let server = session.client.uri();
    match session.output.format {
        Format::Json => session.output.json(&HealthLine { server, serving })?,
        Format::Text if serving => session.output.text(format_args!("{server} serves"))?,
        Format::Text => {}
    }
    match serving {
        true => Ok(()),
        false => Err(Failure::NotServing {
            uri: server.to_owned(),
        }),
    }
}
