//! Values of fields, and the types of the program that hold them.

use crate::units::Energy;

/// The value of a field, on its way in or out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value<'v> {
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
    /// A path. What the file holds decides, see [`super::Sink::content`].
    Path(&'v str),
    /// A list of whole numbers.
    Wholes(&'v [u32]),
    /// A list of texts.
    Texts(&'v [String]),
}

/// A type that a declared field can have.
pub trait Declared: Sized {
    /// The value, which fits the field's form; `None` where the form is not one for this type.
    fn from_value(value: Value<'_>) -> Option<Self>;

    /// What stands for a field that is not set and has no default.
    fn absent() -> Option<Self> {
        None
    }

    /// The value on its way out; `None` for one that is absent.
    fn value(&self) -> Option<Value<'_>>;
}

macro_rules! declared {
    ($($type:ty: $variant:ident($taken:pat => $made:expr), $self:ident => $out:expr;)*) => {$(
        impl Declared for $type {
            fn from_value(value: Value<'_>) -> Option<Self> {
                if let Value::$variant($taken) = value { $made } else { None }
            }

            fn value(&self) -> Option<Value<'_>> {
                let $self = self;
                Some(Value::$variant($out))
            }
        }
    )*};
}

declared! {
    u64: Whole(value => Some(value)), this => *this;
    u32: Whole(value => u32::try_from(value).ok()), this => u64::from(*this);
    f64: Number(value => Some(value)), this => *this;
    Energy: Energy(value => Some(value)), this => *this;
    bool: Switch(value => Some(value)), this => *this;
    String: Text(value => Some(value.to_owned())), this => this.as_str();
    Vec<u32>: Wholes(value => Some(value.to_vec())), this => this.as_slice();
    Vec<String>: Texts(value => Some(value.to_vec())), this => this.as_slice();
}

impl<T: Declared> Declared for Option<T> {
    fn from_value(value: Value<'_>) -> Option<Self> {
        T::from_value(value).map(Some)
    }

    fn absent() -> Option<Self> {
        Some(None)
    }

    fn value(&self) -> Option<Value<'_>> {
        self.as_ref().and_then(Declared::value)
    }
}
