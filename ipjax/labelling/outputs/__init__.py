"""Labels as others read them: BOP's files, COCO's masks, tables, pictures."""
