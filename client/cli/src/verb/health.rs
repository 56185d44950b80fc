//! `wayfold health`

use serde::Serialize;

use crate::{Context, failure::Failure, output::Format};

#[derive(Serialize)]
struct HealthLine<'a> {
    server: &'a str,
    serving: bool,
}

pub(crate) async fn health(context: &mut Context) -> Result<(), Failure> {
    let serving = context.client.is_serving().await?;
    let server = context.client.uri();
    match context.output.format {
        Format::Json => context.output.json(&HealthLine { server, serving })?,
        Format::Text if serving => context.output.text(format_args!("{server} serves"))?,
        Format::Text => {}
    }
    match serving {
        true => Ok(()),
        false => Err(Failure::NotServing {
            uri: server.to_owned(),
        }),
    }
}
