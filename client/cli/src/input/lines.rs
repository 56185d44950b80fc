//! The ends of lines.

use std::{
    io::{self, Read},
    mem,
};

/// Reads text with LF at the end of every line, also where it has CR, or CR and LF, and of the last line. So each line of
/// an editor has one LF.
pub(super) struct Lines<R> {
    input: R,
    /// The last byte that was read.
    last: u8,
}

impl<R> Lines<R> {
    pub(super) fn new(input: R) -> Self {
        Self { input, last: b'\n' }
    }
}

impl<R: Read> Read for Lines<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        loop {
            let read = self.input.read(buffer)?;
            if let (0, Some(end)) = (read, buffer.first_mut()) {
                *end = b'\n';
                let last = mem::replace(&mut self.last, b'\n');
                return Ok(usize::from(!matches!(last, b'\r' | b'\n')));
            }
            let mut kept = 0;
            for at in 0..read {
                let byte = buffer[at];
                let after_cr = mem::replace(&mut self.last, byte) == b'\r';
                if byte == b'\n' && after_cr {
                    continue;
                }
                buffer[kept] = if byte == b'\r' { b'\n' } else { byte };
                kept += 1;
            }
            // Nothing would be the end.
            if kept > 0 || read == 0 {
                return Ok(kept);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_ends_with_lf() {
        for (text, lines) in [
            ("", ""),
            ("1", "1\n"),
            ("1\n\n2\n", "1\n\n2\n"),
            ("1\r\n\r\n2\r\n", "1\n\n2\n"),
            ("1\r\r2\r", "1\n\n2\n"),
            ("\n\r\n\r1", "\n\n\n1\n"),
        ] {
            // One byte at a time, and all at once.
            let mut bytes = Vec::new();
            let mut input = Lines::new(text.as_bytes());
            let mut byte = [0];
            while input.read(&mut byte).unwrap() > 0 {
                bytes.extend(byte);
            }
            assert_eq!(String::from_utf8(bytes).unwrap(), lines, "{text:?}");
            let whole = io::read_to_string(Lines::new(text.as_bytes()));
            assert_eq!(whole.unwrap(), lines, "{text:?}");
        }
    }
}
