//! HTML page: sections of facts, tables, pictures and texts in one self-contained file.
//!
//! On a phone, wide tables scroll inside their own frame; in print, collapsed texts are expanded.

use std::fmt;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::{Table, html};
use crate::app::run::visible::visible;
use crate::shared_bytes::SharedBytes;

const STYLE: &str = include_str!("page.css");
const SCRIPT: &str = include_str!("page.js");
const INTERACTIVE_SCRIPT: &str = include_str!("interactive.js");

/// Tag before the JSON of an interactive path. It cannot occur in a text, where `<` is escaped.
const CONTENT: &str = "<script type=\"application/json\">";

/// One HTML file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Page {
    /// Title of the window and of the page.
    pub title: String,
    /// The answer, below the title.
    pub verdict: String,
    /// Sentence below the verdict.
    pub subtitle: String,
    /// Sections from the top; their titles make the table of contents.
    pub sections: Vec<Section>,
}

/// Section of a page.
#[derive(Clone, Debug, PartialEq)]
pub struct Section {
    /// Heading.
    pub title: String,
    /// Elements from the top.
    pub elements: Vec<PageElement>,
}

/// Element of a section.
#[derive(Clone, Debug, PartialEq)]
pub enum PageElement {
    /// Text.
    Paragraph(String),
    /// Names with their values.
    Facts(Vec<(String, String)>),
    /// Table.
    Table(Table),
    /// Picture.
    Picture {
        /// Bytes of the PNG file.
        png: Vec<u8>,
        /// Caption.
        caption: String,
    },
    /// Interactive path, whose content is JSON.
    Interactive {
        /// File of the content, which may be long.
        content: PathBuf,
        /// Caption.
        caption: String,
    },
    /// Table, collapsed under its title.
    CollapsedTable(Table),
    /// Terms with their definitions.
    Definitions(Vec<(String, String)>),
    /// Preformatted text, collapsed under its name.
    Collapsed {
        /// Name, always visible.
        name: String,
        /// Text.
        text: String,
    },
}

impl Page {
    fn contents(&self) -> impl Iterator<Item = &Path> {
        let elements = self.sections.iter().flat_map(|section| &section.elements);
        elements.filter_map(|element| match element {
            PageElement::Interactive { content, .. } => Some(content.as_path()),
            _ => None,
        })
    }

    /// Writes the file, with the contents of interactive paths as they are read.
    pub fn write(&self, out: &mut impl Write) -> io::Result<()> {
        let html = self.to_html();
        let mut parts = html.split(CONTENT);
        out.write_all(parts.next().unwrap_or_default().as_bytes())?;
        for (path, part) in self.contents().zip(parts) {
            out.write_all(CONTENT.as_bytes())?;
            write_content(path, out)?;
            out.write_all(part.as_bytes())?;
        }
        Ok(())
    }

    /// Renders the file without the contents of interactive paths.
    pub fn to_html(&self) -> String {
        let page = html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    meta name="viewport" content="width=device-width, initial-scale=1";
                    title { (self.title) }
                    style { (PreEscaped(STYLE)) }
                }
                body {
                    main {
                        header {
                            h1 { (self.title) }
                            @if !self.verdict.is_empty() { p.verdict { (self.verdict) } }
                            p.note { (self.subtitle) }
                            nav {
                                @for (index, section) in self.sections.iter().enumerate() {
                                    a href={ "#section-" (index) } { (section.title) }
                                }
                            }
                        }
                        @for (index, section) in self.sections.iter().enumerate() {
                            section id={ "section-" (index) } {
                                h2 { (section.title) }
                                @for element in &section.elements { (element.to_html()) }
                            }
                        }
                    }
                    script { (PreEscaped(SCRIPT)) }
                    @if self.contents().next().is_some() { script { (PreEscaped(INTERACTIVE_SCRIPT)) } }
                }
            }
        };
        // Names from outside do not change the direction of the text or vanish in it.
        visible(&page.into_string()).into_owned()
    }
}

/// Writes the content of an interactive path so that no text of it ends the element.
fn write_content(path: &Path, out: &mut impl Write) -> io::Result<()> {
    let unreadable = |error: &dyn fmt::Display| {
        io::Error::other(format!("cannot read {}: {error}", path.display()))
    };
    let bytes = SharedBytes::of_file(path).map_err(|error| unreadable(&error))?;
    let text = str::from_utf8(&bytes).map_err(|error| unreadable(&error))?;
    for (number, part) in text.split('<').enumerate() {
        if number > 0 {
            out.write_all(br"\u003c")?;
        }
        out.write_all(visible(part).as_bytes())?;
    }
    Ok(())
}

impl PageElement {
    fn to_html(&self) -> Markup {
        match self {
            Self::Paragraph(text) => html! { p { (text) } },
            Self::Facts(facts) => html! {
                dl.facts {
                    @for (name, value) in facts { dt { (name) } dd { (value) } }
                }
            },
            Self::Table(table) => html! {
                h3 { (table.title) }
                (html::table(table))
            },
            Self::Picture { png, caption } => html! {
                figure {
                    img alt=(caption) src={ "data:image/png;base64," (STANDARD.encode(png)) };
                    figcaption { (caption) }
                }
            },
            Self::Interactive { caption, .. } => html! {
                figure.interactive {
                    canvas aria-label=(caption) {}
                    input type="range" min="0" value="0" aria-label="Frame";
                    output {}
                    figcaption { (caption) }
                    (PreEscaped(CONTENT)) (PreEscaped("</script>"))
                }
            },
            Self::CollapsedTable(table) => html! {
                details {
                    summary { (table.title) }
                    (html::table(table))
                }
            },
            Self::Definitions(terms) => html! {
                dl {
                    @for (term, definition) in terms { dt { (term) } dd { (definition) } }
                }
            },
            Self::Collapsed { name, text } => html! {
                details {
                    summary { (name) }
                    pre { (text) }
                }
            },
        }
    }
}

#[cfg(test)]
pub mod tests {
    use super::super::{Cell, Column};
    use super::*;

    /// Two rows with text, link, number, uncertainty and an absent cell.
    pub fn example() -> Table {
        let column = |title: &str| Column {
            title: title.to_owned(),
            definition: "a | b <c>".to_owned(),
        };
        let mean = Cell {
            uncertainty: "±0.0020".to_owned(),
            ..0.023.into()
        };
        let link = Cell {
            link: Some("runs/b.html".to_owned()),
            ..Cell::from("B|C")
        };
        Table {
            name: "table_1".to_owned(),
            title: "Table 1: errors".to_owned(),
            note: "What <b> means.".to_owned(),
            columns: vec![
                Column::from("configuration"),
                column("average positional error [m]"),
                column("success [%]"),
            ],
            rows: vec![
                vec!["A, \"first\"".into(), mean, 100.0.into()],
                vec![link, 0.5.into(), "-".into()],
            ],
        }
    }

    fn page() -> Page {
        Page {
            title: "A <run>".to_owned(),
            subtitle: "of a street".to_owned(),
            verdict: String::new(),
            sections: vec![
                Section {
                    title: "Errors".to_owned(),
                    elements: vec![
                        PageElement::Facts(vec![("seed".to_owned(), "1 & 2".to_owned())]),
                        PageElement::Table(example()),
                    ],
                },
                Section {
                    title: "Pictures".to_owned(),
                    elements: vec![
                        PageElement::Picture {
                            png: vec![1, 2, 3],
                            caption: "path".to_owned(),
                        },
                        PageElement::Collapsed {
                            name: "log".to_owned(),
                            text: "</pre><script>alert()</script>".to_owned(),
                        },
                    ],
                },
            ],
        }
    }

    #[test]
    fn every_tag_that_is_opened_is_closed() {
        let html = page().to_html();
        for tag in [
            "html", "head", "body", "main", "section", "table", "tr", "td", "th", "dl", "details",
            "pre", "figure", "script", "style", "nav", "div", "small",
        ] {
            let opened = html.matches(&format!("<{tag}>")).count()
                + html.matches(&format!("<{tag} ")).count();
            let closed = html.matches(&format!("</{tag}>")).count();
            assert_eq!(opened, closed, "{tag}");
            assert!(opened > 0, "{tag}");
        }
    }

    #[test]
    fn nothing_is_loaded_and_no_text_becomes_a_script() {
        let html = page().to_html();
        for word in ["http://", "https://", "src=\"/", "<link", "@import", "url("] {
            assert!(!html.contains(word), "{word}");
        }
        assert_eq!(html.matches("<script>").count(), 1);
        assert!(html.contains("A &lt;run&gt;"));
    }

    #[test]
    fn every_section_is_in_the_table_of_contents() {
        let html = page().to_html();
        for index in 0..2 {
            assert!(html.contains(&format!("href=\"#section-{index}\"")));
            assert!(html.contains(&format!("id=\"section-{index}\"")));
        }
    }

    #[test]
    fn the_bytes_of_a_picture_are_embedded() {
        let png: Vec<u8> = (0..=255).collect();
        let caption = "\"<path>\"".to_owned();
        let picture = PageElement::Picture {
            png: png.clone(),
            caption,
        };
        let html = picture.to_html().into_string();
        let (_, rest) = html.split_once("base64,").unwrap();
        let (encoded, _) = rest.split_once('"').unwrap();
        assert_eq!(STANDARD.decode(encoded).unwrap(), png);
        assert!(!html.contains("<path>"));
    }
}
