//! The contents of the parts, returned after they were checked.

use prost::Message;
use wayfold_index::Space;

use super::{
    Digest, FORMAT_VERSION, Header, MAX_CONTENT_BYTES, MAX_PAYLOAD_BYTES, OLDEST_FORMAT_VERSION,
    PointPosition, PointProblem, SnapshotError, digest, entries, sessions::CheckedSessions,
};
use crate::{
    END_OF_IDS, space,
    v1::{self, snapshot_content},
};

/// The content of a part.
#[derive(Clone, Debug, PartialEq)]
pub enum Content {
    /// The first part.
    Header(Header),
    /// Points in the form in which an index holds them. Every column is as long as the ids, except that there may be no
    /// payloads. The points meet every guarantee that an index gives about its points.
    Points(v1::Points, Vec<u64>),
    /// Writer sessions and blocks of reserved ids in the form in which an index holds them. The session of every block
    /// was read before it.
    Sessions(v1::SnapshotSessions),
    /// The last part.
    Trailer,
}

/// Checks the parts of one snapshot in order. After an error, the reader must not be used.
#[derive(Debug, Default)]
pub struct Reader {
    parts: u64,
    digest: Digest,
    /// The version of the format, once it is known.
    version: Option<u32>,
    header: Option<Header>,
    points: u64,
    last_id: Option<u64>,
    sessions: CheckedSessions,
    done: bool,
    /// The row that is compared with its canonical form.
    row: Vec<f64>,
}

impl Reader {
    /// Begins to read a snapshot.
    pub fn new() -> Reader {
        Reader::default()
    }

    /// Begins to read a snapshot whose header must have this version of the format.
    pub(super) fn of_version(version: u32) -> Reader {
        Reader {
            version: Some(version),
            ..Reader::default()
        }
    }

    /// The digest of the last part, which covers all parts so far.
    pub fn digest(&self) -> &Digest {
        &self.digest
    }

    /// Checks and decodes the next part.
    ///
    /// # Errors
    /// It is not the part that was written next, or holds points that no index can hold.
    pub fn read(&mut self, part: &v1::SnapshotPart) -> Result<Content, SnapshotError> {
        if self.done {
            return Err(SnapshotError::Trailing { part: self.parts });
        }
        let number = self.parts + 1;
        self.authenticate(number, part)?;
        entries::check(number, &part.content)?;
        let content = v1::SnapshotContent::decode(part.content.clone())
            .map_err(|error| SnapshotError::malformed(number, error))?;
        let content = match (content.kind, &self.header) {
            (Some(snapshot_content::Kind::Header(header)), None) => {
                self.check_version(number, header.format_version)?;
                let header = read_header(number, header)?;
                self.header = Some(header.clone());
                Content::Header(header)
            }
            (Some(snapshot_content::Kind::Points(points)), Some(_)) => {
                self.read_points(number, points)?
            }
            (Some(snapshot_content::Kind::Sessions(sessions)), Some(header)) => {
                if self.version < Some(3) {
                    let problem = "a snapshot of version 2 has no writer sessions";
                    return Err(SnapshotError::malformed(number, problem));
                }
                self.sessions.add(number, header, &sessions)?;
                Content::Sessions(sessions)
            }
            (Some(snapshot_content::Kind::Trailer(trailer)), Some(header)) => {
                let points = ("points", self.points);
                check_count(number, points, ("header", header.point_count))?;
                check_count(number, points, ("trailer", trailer.point_count))?;
                let expected = [trailer.session_count, trailer.block_count];
                for (counted, expected) in self.sessions.counts().into_iter().zip(expected) {
                    check_count(number, counted, ("trailer", expected))?;
                }
                self.done = true;
                Content::Trailer
            }
            (Some(_), None) => {
                let problem = "a snapshot begins with its header";
                return Err(SnapshotError::malformed(number, problem));
            }
            (Some(snapshot_content::Kind::Header(_)), Some(_)) => {
                let problem = "a second header";
                return Err(SnapshotError::malformed(number, problem));
            }
            (None, _) => {
                let problem = "it holds nothing that this version knows";
                return Err(SnapshotError::malformed(number, problem));
            }
        };
        self.parts = number;
        Ok(content)
    }

    /// The number of good parts so far.
    pub fn parts(&self) -> u64 {
        self.parts
    }

    /// True if the trailer was read.
    pub fn is_done(&self) -> bool {
        self.done
    }

    /// Checks that the snapshot is whole; no part follows.
    ///
    /// # Errors
    /// There was no trailer.
    pub fn finish(&self) -> Result<(), SnapshotError> {
        if self.done {
            Ok(())
        } else {
            Err(SnapshotError::CutShort { parts: self.parts })
        }
    }

    /// Checks the size, the digest and the number of a part before its content is decoded.
    fn authenticate(&mut self, number: u64, part: &v1::SnapshotPart) -> Result<(), SnapshotError> {
        if part.content.len() > MAX_CONTENT_BYTES {
            return Err(SnapshotError::TooLarge {
                part: number,
                bytes: part.content.len() as u64,
            });
        }
        // A wrong digest under the expected number is damage; a wrong number is an error of order, even with a wrong
        // digest.
        let found = digest(&self.digest, number, &part.content);
        if found[..] == part.digest[..] && part.number == number {
            self.digest = found;
            return Ok(());
        }
        Err(if part.number == number {
            SnapshotError::Damaged { part: number }
        } else {
            SnapshotError::Order {
                part: number,
                found: part.number,
            }
        })
    }

    fn check_version(&mut self, number: u64, found: u32) -> Result<(), SnapshotError> {
        if !(OLDEST_FORMAT_VERSION..=FORMAT_VERSION).contains(&found) {
            return Err(SnapshotError::version(found));
        }
        match self.version.replace(found) {
            Some(expected) if expected != found => {
                let problem =
                    format!("format version {found}, where the first line says {expected}");
                Err(SnapshotError::malformed(number, problem))
            }
            _ => Ok(()),
        }
    }

    fn read_points(
        &mut self,
        number: u64,
        message: v1::SnapshotPoints,
    ) -> Result<Content, SnapshotError> {
        let Some(header) = self.header.take() else {
            let problem = "a snapshot begins with its header";
            return Err(SnapshotError::malformed(number, problem));
        };
        if !self.sessions.is_empty() {
            let problem = "points after the writer sessions";
            return Err(SnapshotError::malformed(number, problem));
        }
        let points = message.points.unwrap_or_default();
        let modified = message.modified_revisions;
        check_columns(number, &header.space, &points, &modified)?;
        self.points += points.ids.len() as u64;
        if self.points > header.point_count {
            check_count(
                number,
                ("points", self.points),
                ("header", header.point_count),
            )?;
        }
        for row in 0..points.ids.len() {
            self.check_point(&header, &points, &modified, row)
                .map_err(|problem| SnapshotError::Point {
                    position: PointPosition {
                        part: number,
                        row,
                        id: points.ids[row],
                    },
                    problem: Box::new(problem),
                })?;
        }
        self.header = Some(header);
        Ok(Content::Points(points, modified))
    }

    /// Checks that an index as the header describes it may hold this point after the points before it.
    fn check_point(
        &mut self,
        header: &Header,
        points: &v1::Points,
        modified: &[u64],
        row: usize,
    ) -> Result<(), PointProblem> {
        let id = points.ids[row];
        if let Some(before) = self.last_id.filter(|&before| before >= id) {
            return Err(PointProblem::NotAscending { before });
        }
        self.last_id = Some(id);
        if id >= header.next_id {
            let next_id = header.next_id;
            return Err(PointProblem::Id { next_id });
        }
        let (stored, modified) = (points.revisions[row], modified[row]);
        if stored == 0 || stored > modified || modified > header.revision {
            return Err(PointProblem::Revisions {
                stored,
                modified,
                revision: header.revision,
            });
        }
        let bytes = points.payloads.get(row).map_or(0, |payload| payload.len());
        if bytes > MAX_PAYLOAD_BYTES {
            return Err(PointProblem::Payload { bytes });
        }
        let width = header.space.coordinates();
        let coordinates = points
            .states
            .as_ref()
            .map_or(&[][..], |states| &states.coordinates);
        let state = &coordinates[row * width..][..width];
        self.row.clear();
        self.row.extend_from_slice(state);
        header
            .space
            .canonicalize(&mut self.row)
            .map_err(PointProblem::State)?;
        let mut pairs = self.row.iter().zip(state);
        if pairs.all(|(canonical, given)| canonical.to_bits() == given.to_bits()) {
            Ok(())
        } else {
            Err(PointProblem::NotCanonical)
        }
    }
}

fn check_count(
    part: u64,
    (counted, found): (&'static str, u64),
    (said_by, expected): (&'static str, u64),
) -> Result<(), SnapshotError> {
    if found == expected {
        return Ok(());
    }
    Err(SnapshotError::Count {
        part,
        counted,
        found,
        expected,
        said_by,
    })
}

fn read_header(number: u64, header: v1::SnapshotHeader) -> Result<Header, SnapshotError> {
    // A value of a later version declares nothing that this one knows.
    let payload_encoding = header.payload_encoding();
    let space = space::from_message(&header.space.unwrap_or_default()).map_err(|problem| {
        SnapshotError::Space {
            part: number,
            problem: Box::new(problem),
        }
    })?;
    if header.next_id > END_OF_IDS {
        return Err(SnapshotError::next_id(number, header.next_id));
    }
    let revision = header.revision.unwrap_or_default();
    Ok(Header {
        payload_encoding,
        name: header.name,
        uid: revision.uid,
        space,
        revision: revision.number,
        next_id: header.next_id,
        point_count: header.point_count,
    })
}

/// Every column has as many entries as there are ids.
fn check_columns(
    part: u64,
    space: &Space,
    points: &v1::Points,
    modified: &[u64],
) -> Result<(), SnapshotError> {
    let rows = points.ids.len();
    if rows == 0 {
        return Err(SnapshotError::malformed(part, "points without any point"));
    }
    let states = points.states.as_ref();
    let payloads = match points.payloads.len() {
        0 => rows,
        payloads => payloads,
    };
    let columns = [
        (
            "rows of states",
            states.map_or(0, |states| states.row_count as usize),
            rows,
        ),
        (
            "coordinates",
            states.map_or(0, |states| states.coordinates.len()),
            // `MAX_CONTENT_BYTES` bounds the rows of a part, so the product cannot overflow.
            rows * space.coordinates(),
        ),
        ("tags", points.tags.len(), rows),
        ("revisions", points.revisions.len(), rows),
        ("modified_revisions", modified.len(), rows),
        ("payloads", payloads, rows),
    ];
    for (column, found, expected) in columns {
        if found != expected {
            return Err(SnapshotError::Column {
                part,
                column,
                found,
                expected,
            });
        }
    }
    Ok(())
}
