//! `wayfold create`

use serde::Serialize;
use wayfold::{PayloadEncoding, Space};

use super::index_info::InfoLine;
use crate::{Context, failure::Failure, output::Format};
use wayfold::coordinate_names;

const SPACES: &str = "\
Spaces:
  R3               points in space                     x, y, z
  R2*SO2           poses in the plane                  x, y, theta (radians)
  R3*SO3:0.15      poses in space                      x, y, z, qx, qy, qz, qw (w last)
  R1^6, SO2^6      six prismatic, six revolute joints  a number each
  sum(R3, SO3)     poses in space, distances added     x, y, z, qx, qy, qz, qw
  (R3*SO3:0.15)^2  two bodies                          x0, y0, z0, qx0, ... qw1
The factors are Rn, SO2 (SO2[P] for a period P other than 2 pi) and SO3. In A*B:w the weight w
multiplies the squared distance in B, and the distance is the root of the sum; in sum(A, B:w) w
multiplies the distance in B, and the distance is the sum.
Presets: mpnn-se3, ompl-se2, ompl-se3, ompl-torus, moveit-joints-N.

Creating an index that exists with an equal space changes nothing and succeeds.";

/// Creates an index
#[derive(Debug, clap::Args)]
#[command(after_help = SPACES)]
pub(crate) struct CreateArgs {
    /// [a-z0-9][a-z0-9_-]{0,62}
    name: String,
    /// The configuration space of the states: 'R3*SO3:0.15'
    #[arg(long)]
    space: Space,
    /// How payloads hold edges, so that the server's page can draw them: `edges` (ids of 8 bytes), `weighted-edges` (ids and
    /// costs, 16 bytes)
    #[arg(long, value_name = "ENCODING", default_value = "none")]
    payloads: Payloads,
}

/// The declared encoding of payloads.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum Payloads {
    None,
    Edges,
    WeightedEdges,
}

impl From<Payloads> for PayloadEncoding {
    fn from(payloads: Payloads) -> Self {
        match payloads {
            Payloads::None => Self::Unspecified,
            Payloads::Edges => Self::Edges,
            Payloads::WeightedEdges => Self::WeightedEdges,
        }
    }
}

#[derive(Serialize)]
struct Created<'a> {
    #[serde(flatten)]
    index: InfoLine<'a>,
    created: bool,
}

pub(crate) async fn create(args: CreateArgs, context: &mut Context) -> Result<(), Failure> {
    let CreateArgs {
        name,
        space,
        payloads,
    } = args;
    let created = context.client.ensure_index(&name, &space, payloads.into());
    let (index, created) = created.await?;
    match context.output.format {
        Format::Json => context.output.json(&Created {
            index: InfoLine::of(&index),
            created,
        })?,
        Format::Text => {
            let outcome = match created {
                true => "created",
                false => "exists already:",
            };
            let row = coordinate_names(&index.space).join(", ");
            context.output.text(format_args!(
                "{outcome} {} in {}; a row is {row}",
                index.name, index.space
            ))?;
        }
    }
    Ok(())
}
