//! Recordings as they are read: from the start or from a TTI on, whole or torn.

use std::collections::BTreeMap;
use std::io::{self, Read, Seek, SeekFrom};

use mcap::records::Record;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader};
use mcap::{McapError, Summary};
use reveille_common::codec::WIRE_VERSION;
use reveille_common::ids::Tti;
use reveille_common::message::Frame;

use super::VERSION;
use super::bundle::{Bundle, SCENARIO, SUMMARY};
use super::channel::log_time;
use crate::line::{LineError, from_json};

/// The name of the metadata that make a container a recording.
pub const METADATA: &str = "reveille";

/// The longest record that is read, bytes; the file of a harvest trace may be long.
const LONGEST: usize = 1 << 30;

/// Why a recording cannot be read, or not any further.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The operating system refuses.
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
    /// It is something else.
    #[error("is no recording: {0}")]
    Foreign(String),
    /// Another version wrote it.
    #[error(
        "is a recording of version {found}, with messages of version {wire}; this program reads version {VERSION} \
         with {WIRE_VERSION}: use the release of reveille that recorded it"
    )]
    Version {
        /// The version of its form.
        found: String,
        /// The version of its messages.
        wire: String,
    },
    /// It ends in the middle: what recorded it was killed, or the file was cut.
    #[error("is torn after {frames} messages")]
    Torn {
        /// The messages before the tear.
        frames: u64,
    },
    /// Bytes in it were changed.
    #[error("is damaged after {frames} messages: {why}")]
    Damaged {
        /// The messages before the damage.
        frames: u64,
        /// What is wrong.
        why: String,
    },
}

/// A recording that is read.
pub struct Reader<R> {
    source: R,
    linear: LinearReader,
    /// The frame after which the file ends or is torn has been read.
    is_over: bool,
    frames: u64,
    /// The number of the next frame; nothing after a jump.
    next: Option<u32>,
    /// What follows the summary's index is not read again.
    from: Tti,
    bundle: Bundle,
    about: BTreeMap<String, String>,
    summary: Option<String>,
    index: Option<Summary>,
    /// The first frame, which was read to find all that stands before it.
    held: Option<Frame>,
}

impl<R: Read + Seek> Reader<R> {
    /// Opens a recording, before its first frame.
    ///
    /// # Errors
    /// If it is none, is of another version, or torn before its first frame.
    pub fn open(mut source: R) -> Result<Self, RecordingError> {
        let index = index(&mut source)?;
        let summary = match &index {
            Some(index) => summary(&mut source, index)?,
            None => None,
        };
        source.seek(SeekFrom::Start(0))?;
        let mut reader = Self {
            source,
            linear: linear(false),
            is_over: false,
            frames: 0,
            next: Some(0),
            from: Tti::ZERO,
            bundle: Bundle::default(),
            about: BTreeMap::new(),
            summary,
            index,
            held: None,
        };
        reader.held = match reader.read() {
            Ok(frame) => frame,
            Err(RecordingError::Torn { .. }) if !reader.about.is_empty() => {
                reader.is_over = false;
                None
            }
            Err(error) => return Err(error),
        };
        if reader.about.is_empty() || reader.bundle.scenario.is_empty() {
            return Err(RecordingError::Foreign("it was not recorded by reveille".to_owned()));
        }
        Ok(reader)
    }

    /// The scenario and the files that it names.
    pub const fn bundle(&self) -> &Bundle {
        &self.bundle
    }

    /// The run's name.
    pub fn run(&self) -> &str {
        self.about.get("run").map_or("", String::as_str)
    }

    /// The text of the summary, where the run has come to its end.
    pub fn summary(&self) -> Option<&str> {
        self.summary.as_deref()
    }

    /// Whether the file was closed. One that was not is torn; where, only reading shows.
    pub const fn is_closed(&self) -> bool {
        self.index.is_some()
    }

    /// How many messages it holds, where it was closed.
    pub fn len(&self) -> Option<u64> {
        let statistics = self.index.as_ref()?.stats.as_ref()?;
        Some(statistics.message_count)
    }

    /// Whether it was closed and holds no message.
    pub fn is_empty(&self) -> bool {
        self.len() == Some(0)
    }

    /// Goes to the first frame of TTI `tti` or later. What is before it is skipped by the index where there is one.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn seek(&mut self, tti: Tti) -> Result<(), RecordingError> {
        self.from = tti;
        let wanted = log_time(tti);
        let chunks = self.index.as_ref().map_or(&[][..], |index| &index.chunk_indexes);
        let start = chunks
            .iter()
            .filter(|chunk| chunk.message_end_time >= wanted)
            .map(|chunk| chunk.chunk_start_offset)
            .min();
        let (offset, is_inside) = match (start, &self.index) {
            (Some(offset), _) => (offset, true),
            // No chunk ends that late.
            (None, Some(_)) => {
                (self.is_over, self.held) = (true, None);
                return Ok(());
            }
            (None, None) => (0, false),
        };
        self.source.seek(SeekFrom::Start(offset))?;
        self.linear = linear(is_inside);
        (self.is_over, self.held, self.frames) = (false, None, 0);
        self.next = (!is_inside).then_some(0);
        Ok(())
    }

    /// The next frame; nothing after the last.
    ///
    /// # Errors
    /// If the file is torn or damaged here. There is nothing after it.
    pub fn next_frame(&mut self) -> Result<Option<Frame>, RecordingError> {
        loop {
            let frame = match self.held.take() {
                Some(frame) => Some(frame),
                None => self.read()?,
            };
            match frame {
                Some(frame) if frame.tti < self.from => {}
                other => return Ok(other),
            }
        }
    }

    fn read(&mut self) -> Result<Option<Frame>, RecordingError> {
        if self.is_over {
            return Ok(None);
        }
        let read = self.read_on();
        self.is_over = !matches!(read, Ok(Some(_)));
        let frames = self.frames;
        read.map_err(|error| match error {
            Stop::Io(error) => RecordingError::Io(error),
            Stop::Version { found, wire } => RecordingError::Version { found, wire },
            Stop::Format(McapError::UnexpectedEof | McapError::UnexpectedEoc) => RecordingError::Torn { frames },
            Stop::Format(McapError::BadMagic) if frames == 0 => {
                RecordingError::Foreign("it is no MCAP file".to_owned())
            }
            Stop::Format(error) => RecordingError::Damaged {
                frames,
                why: said(&error),
            },
            Stop::Line(error) => RecordingError::Damaged {
                frames,
                why: error.to_string(),
            },
            Stop::Missing => RecordingError::Damaged {
                frames,
                why: "messages are missing".to_owned(),
            },
        })
    }

    fn read_on(&mut self) -> Result<Option<Frame>, Stop> {
        while let Some(event) = self.linear.next_event() {
            match event? {
                LinearReadEvent::ReadRequest(need) => {
                    let read = self.source.read(self.linear.insert(need))?;
                    self.linear.notify_read(read);
                }
                LinearReadEvent::Record { data, opcode } => match mcap::parse_record(opcode, data)? {
                    Record::Message { header, data } => {
                        // They are numbered one after another: a chunk that is none any more is missed.
                        if self.next.is_some_and(|next| next != header.sequence) {
                            return Err(Stop::Missing);
                        }
                        let text = std::str::from_utf8(&data).map_err(|_| LineError::Hex)?;
                        let frame = from_json(text)?;
                        self.next = Some(header.sequence.wrapping_add(1));
                        self.frames += 1;
                        return Ok(Some(frame));
                    }
                    Record::Metadata(metadata) if metadata.name == METADATA => {
                        let value = |key: &str| metadata.metadata.get(key).cloned().unwrap_or_default();
                        let (found, wire) = (value("recording"), value("wire"));
                        if (&found, &wire) != (&VERSION.to_string(), &WIRE_VERSION.to_string()) {
                            return Err(Stop::Version { found, wire });
                        }
                        self.about = metadata.metadata;
                    }
                    Record::Attachment { header, data, .. } => {
                        if header.name == SCENARIO {
                            self.bundle.scenario = String::from_utf8_lossy(&data).into_owned();
                        } else if header.name != SUMMARY && self.frames == 0 {
                            self.bundle.files.push((header.name, data.into_owned()));
                        }
                    }
                    // The end of the data: what follows is the index.
                    Record::DataEnd(_) => {
                        if let (Some(next), Some(all)) = (self.next, self.len())
                            && next != all as u32
                        {
                            return Err(Stop::Missing);
                        }
                        return Ok(None);
                    }
                    Record::Header(_)
                    | Record::Footer(_)
                    | Record::Schema { .. }
                    | Record::Channel(_)
                    | Record::Chunk { .. }
                    | Record::MessageIndex(_)
                    | Record::ChunkIndex(_)
                    | Record::AttachmentIndex(_)
                    | Record::Statistics(_)
                    | Record::Metadata(_)
                    | Record::MetadataIndex(_)
                    | Record::SummaryOffset(_)
                    | Record::Unknown { .. } => {}
                },
            }
        }
        Ok(None)
    }
}

/// Why reading stops.
enum Stop {
    /// Frames that were written are not there.
    Missing,
    Io(io::Error),
    Version {
        found: String,
        wire: String,
    },
    Format(McapError),
    Line(LineError),
}

impl From<io::Error> for Stop {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<McapError> for Stop {
    fn from(error: McapError) -> Self {
        Self::Format(error)
    }
}

impl From<LineError> for Stop {
    fn from(error: LineError) -> Self {
        Self::Line(error)
    }
}

fn linear(is_inside: bool) -> LinearReader {
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(is_inside)
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(LONGEST);
    LinearReader::new_with_options(options)
}

/// The index at the end; nothing if the file was not closed.
fn index<R: Read + Seek>(source: &mut R) -> Result<Option<Summary>, RecordingError> {
    let mut reader = SummaryReader::new();
    loop {
        match reader.next_event() {
            Some(Ok(SummaryReadEvent::ReadRequest(need))) => {
                let read = source.read(reader.insert(need))?;
                reader.notify_read(read);
            }
            Some(Ok(SummaryReadEvent::SeekRequest(to))) => match source.seek(to) {
                Ok(position) => reader.notify_seeked(position),
                // The file is shorter than any index.
                Err(_) => return Ok(None),
            },
            Some(Err(_)) => return Ok(None),
            None => break,
        }
    }
    Ok(reader.finish().filter(|summary| summary.stats.is_some()))
}

/// The summary of the run, by the index.
fn summary<R: Read + Seek>(source: &mut R, index: &Summary) -> Result<Option<String>, RecordingError> {
    let Some(at) = index.attachment_indexes.iter().find(|at| at.name == SUMMARY) else {
        return Ok(None);
    };
    source.seek(SeekFrom::Start(at.offset))?;
    let mut record = vec![0; usize::try_from(at.length).unwrap_or(usize::MAX).min(LONGEST)];
    source.read_exact(&mut record)?;
    // An opcode and a length of eight bytes stand before the record.
    let body = record.get(9..).unwrap_or_default();
    match mcap::parse_record(record[0], body) {
        Ok(Record::Attachment { data, .. }) => Ok(Some(String::from_utf8_lossy(&data).into_owned())),
        Ok(_) | Err(_) => Err(RecordingError::Damaged {
            frames: 0,
            why: "its index does not fit to it".to_owned(),
        }),
    }
}

/// What an error of the container says, with what is behind it.
fn said(error: &McapError) -> String {
    let mut text = error.to_string();
    let mut source = std::error::Error::source(error);
    while let Some(inner) = source {
        text = format!("{text}: {inner}");
        source = inner.source();
    }
    text
}
