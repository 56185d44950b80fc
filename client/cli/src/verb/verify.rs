//! `wayfold verify`

use serde::Serialize;

use super::index_info::InfoLine;
use crate::{Context, allow_broken_pipe, failure::Failure, output::Format, progress};
use wayfold::{Client, Verified};

const EXAMPLES: &str = "\
Examples:
  wayfold verify arm
  wayfold verify arm --queries 1000
  wayfold --server one:50051 --server other:50051 verify arm

The server compares, at one revision, every point that it searches with the one that it stores, and
the answers to sampled queries with brute force over the stored points. The content hash covers the
space and the stored points, and not their revisions. If --server is given more than once, the command
verifies all servers and compares their spaces, counts and hashes; give every --server before the word
verify, or every one after it. The exit status is 1 if anything disagrees.";

/// Compares the answers of an index with its stored points, and servers with each other
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct VerifyArgs {
    /// The index
    name: String,
    /// The number of sampled queries
    #[arg(long, value_name = "N", default_value = "32", value_parser = clap::value_parser!(u32).range(..=1000))]
    queries: u32,
    /// The seed of the sampled queries
    #[arg(long, value_name = "SEED", default_value = "0")]
    seed: u64,
}

/// A verification as a line of JSON.
#[derive(Serialize)]
struct VerifiedLine<'a> {
    server: &'a str,
    agrees: bool,
    #[serde(flatten)]
    index: InfoLine<'a>,
    stored_point_count: u64,
    content_hash: String,
    query_count: u64,
    disagreement_count: u64,
    first_disagreements: &'a [String],
}

/// The comparison of servers as a line of JSON.
#[derive(Serialize)]
struct ComparedLine<'a> {
    same_content: bool,
    differences: &'a [String],
}

pub(crate) async fn verify(args: VerifyArgs, context: &mut Context) -> Result<(), Failure> {
    let mut all: Vec<(Client, Verified)> = Vec::new();
    let clients = [vec![context.client.clone()], context.others.clone()].concat();
    for client in clients {
        let verified = verify_on(&client, &args).await?;
        // A reader that leaves does not hide a disagreement.
        allow_broken_pipe(print(context, &client, &verified))?;
        all.push((client, verified));
    }
    let mut problems = Vec::new();
    for (client, verified) in &all {
        if !verified.agrees() {
            problems.push(format!(
                "{}: the searched points disagree with the stored points in {} places",
                client.uri(),
                verified.disagreement_count
            ));
        }
    }
    if let [(first, one), others @ ..] = &all[..]
        && !others.is_empty()
    {
        let differences: Vec<String> = others
            .iter()
            .flat_map(|(client, other)| differences((first, one), (client, other)))
            .collect();
        allow_broken_pipe(print_comparison(context, &args.name, &differences))?;
        problems.extend(differences);
    }
    if problems.is_empty() {
        return Ok(());
    }
    Err(Failure::Disagreement {
        problems: problems.join("; "),
    })
}

async fn verify_on(client: &Client, args: &VerifyArgs) -> Result<Verified, Failure> {
    let index = client.index(&args.name).await?;
    let bar = progress::bar(Some(0), "verifying", false);
    let verify = index.verify().query_count(args.queries).seed(args.seed);
    let verified = verify.with_progress(|read, to_read| {
        bar.set_length(to_read);
        bar.set_position(read);
    });
    let verified = verified.await?;
    bar.finish_and_clear();
    Ok(verified)
}

fn print(context: &mut Context, client: &Client, verified: &Verified) -> Result<(), Failure> {
    let (output, index) = (&mut context.output, &verified.index);
    if output.format == Format::Json {
        output.json(&VerifiedLine {
            server: client.uri(),
            agrees: verified.agrees(),
            index: InfoLine::of(index),
            stored_point_count: verified.stored_point_count,
            content_hash: hex::encode(verified.content_hash),
            query_count: verified.query_count,
            disagreement_count: verified.disagreement_count,
            first_disagreements: &verified.first_disagreements,
        })?;
        return Ok(());
    }
    let verdict = if verified.agrees() {
        "agrees with its stored points"
    } else {
        "DISAGREES with its stored points"
    };
    output.text(format_args!("{} on {} {verdict}", index.name, client.uri()))?;
    output.text(format_args!("  space     {}", index.space))?;
    output.text(format_args!(
        "  points    {} searched, {} stored",
        index.point_count, verified.stored_point_count
    ))?;
    output.text(format_args!(
        "  queries   {}, each compared with brute force",
        verified.query_count
    ))?;
    output.text(format_args!(
        "  content   {}",
        hex::encode(verified.content_hash)
    ))?;
    output.text(format_args!(
        "  revision  {} (uid {})",
        index.revision.number, index.revision.uid
    ))?;
    for disagreement in &verified.first_disagreements {
        output.text(format_args!("  {disagreement}"))?;
    }
    let more = verified
        .disagreement_count
        .saturating_sub(verified.first_disagreements.len() as u64);
    if more > 0 {
        output.text(format_args!("  and {more} more disagreements"))?;
    }
    Ok(())
}

fn print_comparison(
    context: &mut Context,
    name: &str,
    differences: &[String],
) -> Result<(), Failure> {
    match context.output.format {
        Format::Json => context.output.json(&ComparedLine {
            same_content: differences.is_empty(),
            differences,
        })?,
        Format::Text if differences.is_empty() => context
            .output
            .text(format_args!("the servers hold the same points in {name}"))?,
        Format::Text => {}
    }
    Ok(())
}

/// The differences between the contents of two servers. Their uids and revisions may differ.
fn differences(one: (&Client, &Verified), other: (&Client, &Verified)) -> Vec<String> {
    let mut differences = Vec::new();
    let mut add = |part: &str, one_has: String, other_has: String| {
        if one_has != other_has {
            let (one, other) = (one.0.uri(), other.0.uri());
            differences.push(format!(
                "{part}: {one_has} on {one}, and {other_has} on {other}"
            ));
        }
    };
    let (one, other) = (one.1, other.1);
    add(
        "space",
        one.index.space.to_string(),
        other.index.space.to_string(),
    );
    add(
        "stored points",
        one.stored_point_count.to_string(),
        other.stored_point_count.to_string(),
    );
    add(
        "content",
        hex::encode(one.content_hash),
        hex::encode(other.content_hash),
    );
    differences
}
