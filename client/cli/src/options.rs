//! Options that several verbs share.

use clap::ValueEnum;
use wayfold::{Code, Error, Filter, Include, IndexHandle, Radius, Revision, ScaledRadius};

use crate::{
    failure::Failure,
    parse::{self, MaskedTag, RevisionArg},
};

/// The points that a read searches.
#[derive(Debug, clap::Args)]
pub(crate) struct FilterArgs {
    /// Only points with this tag, or with these bits under the mask
    ///
    /// Numbers are decimal, or hexadecimal after 0x: 0x3/0xff selects the tags whose lowest eight bits are 3.
    #[arg(long, value_name = "VALUE[/MASK]", value_parser = parse::masked_tag)]
    tag: Option<MaskedTag>,
    /// Only points whose state a later revision stored
    ///
    /// If the index is not at this revision yet, the command waits for it, up to --timeout. With @UID the command fails
    /// if the index was deleted and created again, or restored.
    #[arg(long, value_name = "NUMBER[@UID]", value_parser = parse::revision)]
    since: Option<RevisionArg>,
}

impl FilterArgs {
    pub(crate) fn filter(&self, index: &IndexHandle) -> Filter {
        filter(self.tag, self.since.as_ref(), index)
    }

    /// The failure of a read by this filter. If it is late, it names a revision that the index has not reached.
    pub(crate) fn failure(&self, index: &IndexHandle, error: Error) -> Failure {
        let newest = index.revision().number;
        match &self.since {
            Some(since) if since.number > newest && error.code() == Code::DeadlineExceeded => {
                let (name, number) = (index.name(), since.number);
                Failure::Stopped {
                    done: format!(
                        "waited for revision {number}, which --since names: {name} was at revision {newest}"
                    ),
                    source: Box::new(error.into()),
                }
            }
            _ => error.into(),
        }
    }
}

/// The filter of a tag and a revision that may be given.
pub(crate) fn filter(
    tag: Option<MaskedTag>,
    since: Option<&RevisionArg>,
    index: &IndexHandle,
) -> Filter {
    let mut filter = Filter::default();
    if let Some(MaskedTag { value, mask }) = tag {
        filter = filter.tag(mask, value);
    }
    if let Some(since) = since {
        filter = filter.since(revision(since, index));
    }
    filter
}

/// The revision that is given; a number alone counts the past that the index has now.
pub(crate) fn revision(revision: &RevisionArg, index: &IndexHandle) -> Revision {
    match &revision.uid {
        Some(uid) => Revision::new(&**uid, revision.number),
        None => index.revision_at(revision.number),
    }
}

/// The choice to read the newest mutations of a cluster.
#[derive(Debug, clap::Args)]
pub(crate) struct LatestArgs {
    /// See all that any server of a cluster has acknowledged; a server alone always shows it
    #[arg(long)]
    latest: bool,
}

impl LatestArgs {
    /// A handle of the index with this choice.
    pub(crate) fn of(&self, index: IndexHandle) -> IndexHandle {
        match self.latest {
            true => index.latest(),
            false => index,
        }
    }
}

/// The columns of an answer.
#[derive(Debug, clap::Args)]
pub(crate) struct IncludeArgs {
    /// The columns to read of each point in addition to its id, separated by commas
    ///
    /// Payloads are base64 in JSON and in CSV.
    #[arg(long, value_enum, value_name = "COLUMNS", value_delimiter = ',')]
    include: Option<Vec<Column>>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Column {
    States,
    Tags,
    Revisions,
    Payloads,
}

impl IncludeArgs {
    /// The columns that are named; `default` if none are.
    pub(crate) fn include_or(&self, default: Include) -> Include {
        self.include.as_deref().map_or(default, include)
    }
}

/// The columns as the library takes them.
pub(crate) fn include(columns: &[Column]) -> Include {
    Include {
        states: columns.contains(&Column::States),
        tags: columns.contains(&Column::Tags),
        revisions: columns.contains(&Column::Revisions),
        payloads: columns.contains(&Column::Payloads),
    }
}

/// All columns but payloads: the default of `get`, `watch` and a scan in JSON.
pub(crate) const POINT_COLUMNS: Include = Include::none().states().tags().revisions();

/// The greatest distance of a neighbour.
#[derive(Debug, clap::Args)]
pub(crate) struct RadiusArgs {
    /// Only points at this distance or nearer
    #[arg(long, value_name = "R", value_parser = parse::distance, allow_negative_numbers = true)]
    radius: Option<f64>,
    /// In the place of --radius: F * (ln n / n)^(1/d), for n points in a space of dimension d
    #[arg(long, value_name = "F", value_parser = parse::finite, allow_negative_numbers = true, conflicts_with = "radius")]
    radius_factor: Option<f64>,
    /// The greatest radius that --radius-factor gives
    #[arg(long, value_name = "R", value_parser = parse::distance, allow_negative_numbers = true, requires = "radius_factor")]
    radius_max: Option<f64>,
}

impl RadiusArgs {
    /// The radius, if one is given.
    pub(crate) fn radius(&self) -> Option<Radius> {
        let scaled = self.radius_factor.map(|factor| {
            let radius = ScaledRadius::new(factor);
            match self.radius_max {
                Some(max) => radius.max(max),
                None => radius,
            }
        });
        let fixed = self.radius.map(Radius::Fixed);
        fixed.or(scaled.map(Radius::Scaled))
    }
}
