//! Snapshot files: a first line with the format version, and the parts, each after its length.

use std::io::{self, BufRead, BufReader, Read, Write};

use bytes::Bytes;
use prost::Message;

use super::{
    Content, FORMAT_VERSION, MAX_CONTENT_BYTES, OLDEST_FORMAT_VERSION, Reader, SnapshotError,
};
use crate::v1::{self, snapshot_content::Kind};

/// The beginning of the first line; a version follows.
const NAME: &str = "wayfold snapshot ";

/// The most bytes of the first line.
const MAX_LINE: u64 = 64;

/// The most bytes of an encoded part: its content, and 256 bytes for the other fields.
const MAX_PART_BYTES: u64 = MAX_CONTENT_BYTES as u64 + 256;

/// Writes the parts of a snapshot into a file. The caller ends with [`FileWriter::finish`],
/// and syncs the file.
#[derive(Debug)]
pub struct FileWriter<W> {
    file: W,
    buffer: Vec<u8>,
    begun: bool,
}

impl<W: Write> FileWriter<W> {
    /// Begins the file. Nothing is written before the first part.
    pub fn new(file: W) -> FileWriter<W> {
        FileWriter {
            file,
            buffer: Vec::new(),
            begun: false,
        }
    }

    /// Writes the next part, and before the first part the line with its version.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&mut self, part: &v1::SnapshotPart) -> io::Result<()> {
        self.buffer.clear();
        if !self.begun {
            writeln!(self.buffer, "{NAME}{}", version_of(part))?;
            self.begun = true;
        }
        part.encode_length_delimited(&mut self.buffer)
            .map_err(io::Error::other)?;
        self.file.write_all(&self.buffer)
    }

    /// Flushes the file, and gives it back.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn finish(mut self) -> io::Result<W> {
        self.file.flush()?;
        Ok(self.file)
    }
}

/// The format version of the header in a part. A part without a header gets the newest: a reader refuses it anyway.
fn version_of(part: &v1::SnapshotPart) -> u32 {
    match v1::SnapshotContent::decode(part.content.clone()) {
        Ok(v1::SnapshotContent {
            kind: Some(Kind::Header(header)),
        }) => header.format_version,
        _ => FORMAT_VERSION,
    }
}

/// Reads the parts of a snapshot from a file, and checks them.
#[derive(Debug)]
pub struct FileReader<R> {
    file: BufReader<R>,
    reader: Reader,
}

impl<R: Read> FileReader<R> {
    /// Begins to read a file.
    ///
    /// # Errors
    /// The file is not a snapshot, has another version, or cannot be read.
    pub fn new(file: R) -> Result<FileReader<R>, SnapshotError> {
        let mut file = BufReader::new(file);
        let mut line = Vec::new();
        file.by_ref().take(MAX_LINE).read_until(b'\n', &mut line)?;
        let line = String::from_utf8(line).map_err(|_| SnapshotError::NotSnapshot)?;
        let version = line
            .strip_prefix(NAME)
            .and_then(|rest| rest.strip_suffix('\n'))
            .ok_or(SnapshotError::NotSnapshot)?;
        let known = OLDEST_FORMAT_VERSION..=FORMAT_VERSION;
        let version = known
            .into_iter()
            .find(|known| known.to_string() == version)
            .ok_or_else(|| SnapshotError::version(version.escape_debug()))?;
        Ok(FileReader {
            file,
            reader: Reader::of_version(version),
        })
    }

    /// Reads the next part and its content; `None` at the end of the file, after the trailer.
    ///
    /// # Errors
    /// The file ends before its trailer, continues after it, is damaged, holds points that no index can hold, or cannot
    /// be read.
    pub fn next_part(&mut self) -> Result<Option<(v1::SnapshotPart, Content)>, SnapshotError> {
        let part = self.reader.parts() + 1;
        if self.file.fill_buf()?.is_empty() {
            return self.reader.finish().map(|()| None);
        }
        if self.reader.is_done() {
            return Err(SnapshotError::Trailing { part: part - 1 });
        }
        let bytes = self.length(part)?;
        if bytes > MAX_PART_BYTES {
            return Err(SnapshotError::TooLarge { part, bytes });
        }
        let mut message = Vec::new();
        self.file.by_ref().take(bytes).read_to_end(&mut message)?;
        if (message.len() as u64) < bytes {
            return Err(SnapshotError::CutShort { parts: part - 1 });
        }
        let message = v1::SnapshotPart::decode(Bytes::from(message))
            .map_err(|error| SnapshotError::malformed(part, error))?;
        let content = self.reader.read(&message)?;
        Ok(Some((message, content)))
    }

    /// The length before a part: a varint.
    fn length(&mut self, part: u64) -> Result<u64, SnapshotError> {
        let mut length = 0_u64;
        for place in 0..10 {
            let Some(&byte) = self.file.fill_buf()?.first() else {
                return Err(SnapshotError::CutShort { parts: part - 1 });
            };
            self.file.consume(1);
            // A tenth byte exceeds every allowed length.
            length |= u64::from(byte & 0x7f) << (7 * place).min(57);
            if byte & 0x80 == 0 {
                return Ok(length);
            }
        }
        Err(SnapshotError::malformed(part, "its length is no number"))
    }
}
