//! Values of fields, and the conversion between them and the Rust types of fields. A new kind of value needs an arm in
//! `fingerprint.rs`, which hashes each kind in its own way, in `toml_page.rs` and in `schema.rs`.

use crate::units::Energy;

/// The value of a field, read or written.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FieldValue<'v> {
    /// A whole number.
    Whole(u64),
    /// A number.
    Number(f64),
    /// An amount of energy.
    Energy(Energy),
    /// True or false.
    Switch(bool),
    /// A word or a text.
    Text(&'v str),
    /// A path, or a word in place of a file. Only sinks receive it: a file's field is read as [`Self::Text`]. The hash
    /// uses the content of the file instead, see [`super::FieldSink::content`].
    Path(&'v str),
    /// A list of whole numbers.
    Wholes(&'v [u32]),
    /// A list of texts.
    Texts(&'v [String]),
}

/// A type that a declared field can have.
pub trait FieldRepr: Sized {
    /// Converts the value, which is valid for the field's type; `None` if the value's type does not match.
    fn from_value(value: FieldValue<'_>) -> Option<Self>;

    /// Returns the value of a field that is not set and has no default; `None` if the type requires a value.
    fn absent() -> Option<Self> {
        None
    }

    /// Returns the value to write; `None` if it is absent.
    fn value(&self) -> Option<FieldValue<'_>>;
}

macro_rules! impl_field_repr {
    ($($type:ty: $variant:ident($value:pat => $converted:expr), $self:ident => $out:expr;)*) => {$(
        impl FieldRepr for $type {
            fn from_value(value: FieldValue<'_>) -> Option<Self> {
                if let FieldValue::$variant($value) = value { $converted } else { None }
            }

            fn value(&self) -> Option<FieldValue<'_>> {
                let $self = self;
                Some(FieldValue::$variant($out))
            }
        }
    )*};
}

impl_field_repr! {
    u64: Whole(value => Some(value)), this => *this;
    u32: Whole(value => u32::try_from(value).ok()), this => u64::from(*this);
    f64: Number(value => Some(value)), this => *this;
    Energy: Energy(value => Some(value)), this => *this;
    bool: Switch(value => Some(value)), this => *this;
    String: Text(value => Some(value.to_owned())), this => this.as_str();
    Vec<u32>: Wholes(value => Some(value.to_vec())), this => this.as_slice();
    Vec<String>: Texts(value => Some(value.to_vec())), this => this.as_slice();
}

impl<T: FieldRepr> FieldRepr for Option<T> {
    fn from_value(value: FieldValue<'_>) -> Option<Self> {
        T::from_value(value).map(Some)
    }

    fn absent() -> Option<Self> {
        Some(None)
    }

    fn value(&self) -> Option<FieldValue<'_>> {
        self.as_ref().and_then(FieldRepr::value)
    }
}
