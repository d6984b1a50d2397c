"""Every entry point by name."""

import file_entries
import folder_entries
import value_entries
from fuzzing import Entry

ENTRIES: dict[str, Entry] = {
    entry.name: entry
    for module in (file_entries, folder_entries, value_entries)
    for entry in module.ENTRIES
}
