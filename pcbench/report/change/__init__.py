"""The change between epochs as texts, tables, maps, pictures and sheets."""
