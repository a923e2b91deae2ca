//! [`crate::declare!`], which declares a struct of settings and the section of its fields together. Fields are read,
//! written and hashed in the order of their declaration. Names and doc comments appear in `docs/scenario.md`, which a
//! test compares.

/// Declares a struct and the fields of its section together. The doc comments become the help of the fields; the one
/// of the struct describes the section.
///
/// ```
/// use reveille_common::declare::{POSITIVE, number};
///
/// reveille_common::declare! {
///     /// A rectangular plot.
///     #[derive(Clone, Copy, Debug)]
///     pub struct Plot in "plot" {
///         /// East-west side.
///         pub width: f64 = number(POSITIVE, 20.0).unit("metres").source("Table II"),
///         /// North-south side.
///         pub height: f64 = number(POSITIVE, 20.0).unit("metres").derived("as `width`") => width,
///     }
/// }
/// assert_eq!(Plot::SECTION.field("width").map(|field| field.help), Some("East-west side."));
/// ```
///
/// A default derived from other fields is an expression over the preceding fields, after `=>`; it may use `?`. The
/// struct gets `SECTION`, [`Settings`](super::Settings), [`Visit`](super::Visit), and `read`, which takes the values of
/// a [`FieldReader`](super::FieldReader) and checks their ranges.
///
/// `struct Plot in "plot" only with "layout.kind" = &["grid", "hex"]; { … }` sets the condition of the whole section,
/// [`Section::only_with`](super::Section::only_with). A section also belongs in the declaration of its configuration.
/// A struct that also derives `Serialize` is part of the wire format, by the order of its fields.
#[macro_export]
macro_rules! declare {
    (
        $(#[doc = $about:literal])+
        #[derive($($derive:path),+ $(,)?)]
        $(#[serde($($serde:tt)*)])*
        $vis:vis struct $type:ident in $path:literal $(only with $condition:literal = $values:expr;)? {
            $(
                $(#[doc = $help:literal])+
                $field_vis:vis $name:ident: $of:ty = $field:expr $(=> $derived:expr)?
            ),+ $(,)?
        }
    ) => {
        $(#[doc = $about])+
        #[derive($($derive),+)]
        $(#[serde($($serde)*)])*
        $vis struct $type {
            $( $(#[doc = $help])+ $field_vis $name: $of ),+
        }

        impl $type {
            /// The declaration of the fields.
            $vis const SECTION: &'static $crate::declare::Section = &$crate::declare::Section {
                path: $path,
                about: concat!($($about),+).trim_ascii(),
                fields: &[$( $field.with_name_and_help(stringify!($name), concat!($($help),+).trim_ascii()) ),+],
                only_with: $crate::declare!(@condition $($condition = $values)?),
            };

            /// Reads the values of the fields from `reader`.
            ///
            /// # Errors
            /// If a value is out of its range, or a required one is not set.
            $vis fn read(reader: &$crate::declare::FieldReader<'_>) -> Result<Self, $crate::declare::ScenarioError> {
                let section = Self::SECTION;
                let mut fields = section.fields.iter();
                $(
                    let field = fields.next().expect("one for each");
                    let $name: $of = $crate::declare!(@read reader, section, field, $of $(, $derived)?);
                )+
                Ok(Self { $($name),+ })
            }
        }

        impl $crate::declare::Settings for $type {
            const SECTION: &'static $crate::declare::Section = <$type>::SECTION;

            fn read(reader: &$crate::declare::FieldReader<'_>) -> Result<Self, $crate::declare::ScenarioError> {
                <$type>::read(reader)
            }
        }

        impl $crate::declare::Visit for $type {
            fn visit(&self, sink: &mut dyn $crate::declare::FieldSink) {
                let section = Self::SECTION;
                let values = [$( $crate::declare::FieldRepr::value(&self.$name) ),+];
                for (field, value) in section.fields.iter().zip(values) {
                    if let Some(value) = value {
                        sink.field(section, field, value);
                    }
                }
            }
        }
    };
    (@condition) => { None };
    (@condition $field:literal = $values:expr) => {
        Some($crate::declare::FieldCondition { field: $field, values: $values })
    };
    (@read $reader:ident, $section:ident, $field:ident, $of:ty) => {
        $reader.field::<$of>($section, $field)?
    };
    (@read $reader:ident, $section:ident, $field:ident, $of:ty, $derived:expr) => {
        match $reader.optional_field::<$of>($section, $field)? {
            Some(value) => value,
            None => $derived,
        }
    };
}
