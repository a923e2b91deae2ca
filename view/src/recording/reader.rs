//! Reader of recordings, whole or torn, from the start or from any TTI. It must read what `writer` writes: metadata,
//! attachments, then messages with consecutive numbers and TTIs that never decrease. `inspect`, `compare` and the
//! dashboard open recordings with it. They print a [`RecordingError`] after the name of the file.

use std::collections::BTreeMap;
use std::io::{self, Read, Seek, SeekFrom};

use mcap::records::Record;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader};
use mcap::{McapError, Summary};
use reveille_common::codec::WIRE_VERSION;
use reveille_common::digits::count_noun;
use reveille_common::ids::Tti;
use reveille_common::message::Frame;

use super::bundle::{SCENARIO_FILE, ScenarioBundle};
use super::{SUMMARY_FILE, VERSION, log_time};
use crate::frame_line::{LineError, from_json};

/// Name of the metadata record that marks a container as a recording.
pub(super) const METADATA_NAME: &str = "reveille";

/// Maximum length of a record, bytes; a harvest trace may be long.
const MAX_RECORD_BYTES: usize = 1 << 30;

/// Reason why a recording cannot be read, or not any further.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The operating system returned an error.
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
    /// The file is not a recording.
    #[error("is not a recording: {0}")]
    Foreign(String),
    /// Another version wrote the recording.
    #[error(
        "is a recording of version {found}, with messages of version {wire}; this program reads version {VERSION} \
         with {WIRE_VERSION}: use the release of reveille that recorded it"
    )]
    Version {
        /// Version of the recording format.
        found: String,
        /// Version of the messages.
        wire: String,
    },
    /// The file is truncated: the recording process was killed, or the file was cut.
    #[error("the recording is truncated after {}", count_noun(*frames, "message"))]
    Torn {
        /// Number of messages read before the tear, since the last seek if any.
        frames: u64,
    },
    /// The content was changed.
    #[error("the recording is damaged after {}: {cause}", count_noun(*frames, "message"))]
    Damaged {
        /// Number of messages read before the damage, since the last seek if any.
        frames: u64,
        /// Description of the damage.
        cause: String,
    },
}

/// Reader of one recording.
pub struct RecordingReader<R> {
    source: R,
    linear: LinearReader,
    /// Whether the last frame before the end or a tear has been read.
    is_over: bool,
    /// Number of frames read since the last seek, if any.
    frames_read: u64,
    /// Number of the next frame; unknown after a seek by the index.
    next_sequence: Option<u32>,
    /// First TTI to return; earlier frames are skipped.
    first_tti: Tti,
    bundle: ScenarioBundle,
    metadata: BTreeMap<String, String>,
    /// Text of the run's `summary.json`, if the run has ended; not the summary of MCAP, which is `index`.
    summary: Option<String>,
    /// Index at the end of the file, which MCAP calls a summary; `None` if the file was not closed.
    index: Option<Summary>,
    /// The first frame, which was read early to find the records before it.
    first_frame: Option<Frame>,
}

impl<R: Read + Seek> RecordingReader<R> {
    /// Opens a recording before its first frame.
    ///
    /// # Errors
    /// If the file is not a recording, is of another version, or is torn before its first frame.
    pub fn open(mut source: R) -> Result<Self, RecordingError> {
        check_magic(&mut source)?;
        let index = read_index(&mut source)?;
        let summary = match &index {
            Some(index) => read_summary(&mut source, index)?,
            None => None,
        };
        source.seek(SeekFrom::Start(0))?;
        let mut reader = Self {
            source,
            linear: new_linear_reader(false),
            is_over: false,
            frames_read: 0,
            next_sequence: Some(0),
            first_tti: Tti::ZERO,
            bundle: ScenarioBundle::default(),
            metadata: BTreeMap::new(),
            summary,
            index,
            first_frame: None,
        };
        reader.first_frame = match reader.read_frame() {
            Ok(frame) => frame,
            // The scenario is usable even without a whole frame; `next_frame` reports the tear again.
            Err(RecordingError::Torn { .. }) if !reader.metadata.is_empty() => {
                reader.is_over = false;
                None
            }
            Err(error) => return Err(error),
        };
        if reader.metadata.is_empty() || reader.bundle.text.is_empty() {
            return Err(RecordingError::Foreign("it was not recorded by reveille".to_owned()));
        }
        Ok(reader)
    }

    /// The scenario and its scenario files.
    pub const fn bundle(&self) -> &ScenarioBundle {
        &self.bundle
    }

    /// Name of the run.
    pub fn run(&self) -> &str {
        self.metadata.get("run").map_or("", String::as_str)
    }

    /// Text of the summary, if the run has ended.
    pub fn summary(&self) -> Option<&str> {
        self.summary.as_deref()
    }

    /// Whether the file was closed. An unclosed file is torn; the place is found only by reading.
    pub const fn is_closed(&self) -> bool {
        self.index.is_some()
    }

    /// Number of messages, if the file was closed.
    pub fn len(&self) -> Option<u64> {
        let statistics = self.index.as_ref()?.stats.as_ref()?;
        Some(statistics.message_count)
    }

    /// Whether the file was closed and holds no messages.
    pub fn is_empty(&self) -> bool {
        self.len() == Some(0)
    }

    /// Moves to the first frame of TTI `tti` or later, forwards or backwards. The index, if any, is used to skip
    /// earlier frames.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn seek(&mut self, tti: Tti) -> Result<(), RecordingError> {
        self.first_tti = tti;
        let wanted_time = log_time(tti);
        let chunks = self.index.as_ref().map_or(&[][..], |index| &index.chunk_indexes);
        let start = chunks
            .iter()
            .filter(|chunk| chunk.message_end_time >= wanted_time)
            .map(|chunk| chunk.chunk_start_offset)
            .min();
        let (offset, starts_mid_file) = match (start, &self.index) {
            (Some(offset), _) => (offset, true),
            // No chunk reaches this TTI.
            (None, Some(_)) => {
                (self.is_over, self.first_frame) = (true, None);
                return Ok(());
            }
            // A torn file has no index, so it is read from the start.
            (None, None) => (0, false),
        };
        self.source.seek(SeekFrom::Start(offset))?;
        self.linear = new_linear_reader(starts_mid_file);
        (self.is_over, self.first_frame, self.frames_read) = (false, None, 0);
        self.next_sequence = (!starts_mid_file).then_some(0);
        Ok(())
    }

    /// Returns the next frame, or `None` after the last.
    ///
    /// # Errors
    /// If the file is torn or damaged at this place. Later calls return `None`.
    pub fn next_frame(&mut self) -> Result<Option<Frame>, RecordingError> {
        loop {
            let frame = match self.first_frame.take() {
                Some(frame) => Some(frame),
                None => self.read_frame()?,
            };
            match frame {
                Some(frame) if frame.tti < self.first_tti => {}
                other => return Ok(other),
            }
        }
    }

    /// Returns the next frame of the file, without regard to `first_tti` and `first_frame`.
    fn read_frame(&mut self) -> Result<Option<Frame>, RecordingError> {
        if self.is_over {
            return Ok(None);
        }
        let read = self.read_to_message();
        self.is_over = !matches!(read, Ok(Some(_)));
        let frames = self.frames_read;
        read.map_err(|error| match error {
            ReadStop::Io(error) => RecordingError::Io(error),
            ReadStop::Version { found, wire } => RecordingError::Version { found, wire },
            ReadStop::Format(McapError::UnexpectedEof | McapError::UnexpectedEoc) => RecordingError::Torn { frames },
            ReadStop::Format(McapError::BadMagic) if frames == 0 => {
                RecordingError::Foreign("it is not an MCAP file".to_owned())
            }
            ReadStop::Format(error) => RecordingError::Damaged {
                frames,
                cause: error_chain(&error),
            },
            ReadStop::Line(error) => RecordingError::Damaged {
                frames,
                cause: error.to_string(),
            },
            ReadStop::Missing => RecordingError::Damaged {
                frames,
                cause: "messages are missing".to_owned(),
            },
        })
    }

    /// Reads records up to the next message. Stores the metadata and the attachments on the way.
    fn read_to_message(&mut self) -> Result<Option<Frame>, ReadStop> {
        while let Some(event) = self.linear.next_event() {
            match event? {
                LinearReadEvent::ReadRequest(need) => {
                    let read = self.source.read(self.linear.insert(need))?;
                    self.linear.notify_read(read);
                }
                LinearReadEvent::Record { data, opcode } => match mcap::parse_record(opcode, data)? {
                    Record::Message { header, data } => {
                        // Numbers are consecutive. A chunk that damage has turned into an unknown record therefore
                        // shows as a gap.
                        if self.next_sequence.is_some_and(|next| next != header.sequence) {
                            return Err(ReadStop::Missing);
                        }
                        let text = std::str::from_utf8(&data).map_err(|_| LineError::Hex)?;
                        let frame = from_json(text)?;
                        // Sequence numbers have 32 bits and wrap, as in the writer.
                        self.next_sequence = Some(header.sequence.wrapping_add(1));
                        self.frames_read += 1;
                        return Ok(Some(frame));
                    }
                    Record::Metadata(metadata) if metadata.name == METADATA_NAME => {
                        let value = |key: &str| metadata.metadata.get(key).cloned().unwrap_or_default();
                        let (found, wire) = (value("recording"), value("wire"));
                        if (&found, &wire) != (&VERSION.to_string(), &WIRE_VERSION.to_string()) {
                            return Err(ReadStop::Version { found, wire });
                        }
                        self.metadata = metadata.metadata;
                    }
                    Record::Attachment { header, data, .. } => {
                        if header.name == SCENARIO_FILE {
                            self.bundle.text = String::from_utf8_lossy(&data).into_owned();
                        } else if header.name != SUMMARY_FILE && self.frames_read == 0 {
                            // A seek without an index reads the attachments again.
                            let mut files = self.bundle.referenced_files.iter();
                            if files.all(|(name, _)| *name != header.name) {
                                self.bundle.referenced_files.push((header.name, data.into_owned()));
                            }
                        }
                    }
                    // The end of the data; only the index follows.
                    Record::DataEnd(_) => {
                        if let (Some(next), Some(frame_count)) = (self.next_sequence, self.len())
                            && next != frame_count as u32
                        {
                            return Err(ReadStop::Missing);
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

/// Reason why reading stops.
enum ReadStop {
    /// Written frames are missing.
    Missing,
    Io(io::Error),
    Version {
        found: String,
        wire: String,
    },
    Format(McapError),
    Line(LineError),
}

impl From<io::Error> for ReadStop {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<McapError> for ReadStop {
    fn from(error: McapError) -> Self {
        Self::Format(error)
    }
}

impl From<LineError> for ReadStop {
    fn from(error: LineError) -> Self {
        Self::Line(error)
    }
}

fn new_linear_reader(starts_mid_file: bool) -> LinearReader {
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(starts_mid_file)
        // A damaged chunk must not yield frames before its checksum fails.
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(MAX_RECORD_BYTES);
    LinearReader::new_with_options(options)
}

/// Reads the index at the end; `None` if the file was not closed.
fn read_index<R: Read + Seek>(source: &mut R) -> Result<Option<Summary>, RecordingError> {
    let mut reader = SummaryReader::new();
    loop {
        match reader.next_event() {
            Some(Ok(SummaryReadEvent::ReadRequest(need))) => {
                let read = source.read(reader.insert(need))?;
                reader.notify_read(read);
            }
            Some(Ok(SummaryReadEvent::SeekRequest(to))) => match source.seek(to) {
                Ok(position) => reader.notify_seeked(position),
                // The file is too short to hold an index.
                Err(_) => return Ok(None),
            },
            // Without a usable index the frames can still be read in order.
            Some(Err(_)) => return Ok(None),
            None => break,
        }
    }
    Ok(reader.finish().filter(|index| index.stats.is_some()))
}

/// Refuses a file that starts differently from MCAP files, even if it is shorter than their magic bytes.
fn check_magic<R: Read + Seek>(source: &mut R) -> Result<(), RecordingError> {
    let mut start = Vec::new();
    source.seek(SeekFrom::Start(0))?;
    source.take(mcap::MAGIC.len() as u64).read_to_end(&mut start)?;
    if mcap::MAGIC.starts_with(&start) {
        Ok(())
    } else {
        Err(RecordingError::Foreign("it is not an MCAP file".to_owned()))
    }
}

/// Reads the summary of the run through the index.
fn read_summary<R: Read + Seek>(source: &mut R, index: &Summary) -> Result<Option<String>, RecordingError> {
    let Some(entry) = index.attachment_indexes.iter().find(|entry| entry.name == SUMMARY_FILE) else {
        return Ok(None);
    };
    source.seek(SeekFrom::Start(entry.offset))?;
    // A corrupt index can claim any length.
    let mut record = vec![
        0;
        usize::try_from(entry.length)
            .unwrap_or(usize::MAX)
            .min(MAX_RECORD_BYTES)
    ];
    source.read_exact(&mut record)?;
    // The record follows an opcode and a length of eight bytes. A corrupt index can also claim no bytes at all.
    let (opcode, body) = (record.first().copied(), record.get(9..));
    match mcap::parse_record(opcode.unwrap_or_default(), body.unwrap_or_default()) {
        Ok(Record::Attachment { data, .. }) => Ok(Some(String::from_utf8_lossy(&data).into_owned())),
        Ok(_) | Err(_) => Err(RecordingError::Damaged {
            frames: 0,
            cause: "its index does not match it".to_owned(),
        }),
    }
}

/// Describes a container error with its causes.
fn error_chain(error: &McapError) -> String {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(inner) = cause {
        text = format!("{text}: {inner}");
        cause = inner.source();
    }
    text
}
