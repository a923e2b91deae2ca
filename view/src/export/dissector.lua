-- Dissects messages of Reveille in Wireshark and tshark.
--
--   reveille inspect export run.mcap --to pcapng --out run.pcapng
--   reveille inspect export --dissector reveille.lua
--   wireshark -X lua_script:reveille.lua run.pcapng
--
-- Or put it into the folder of personal Lua plugins. Filters: reveille.wake, reveille.wake.device == 7.

local reveille = Proto("reveille", "Reveille")
local fields, kinds = {}, {}
--@version
local header = {
    tti = ProtoField.uint64("reveille.tti", "TTI"),
    plane = ProtoField.string("reveille.plane", "plane"),
    kind = ProtoField.string("reveille.kind", "kind"),
    text = ProtoField.string("reveille.text", "text"),
    bytes = ProtoField.uint32("reveille.bytes", "bytes"),
}
--@fields
--@kinds
local all = {}
for _, field in pairs(header) do
    table.insert(all, field)
end
for _, field in pairs(fields) do
    table.insert(all, field)
end
reveille.fields = all
local malformed = ProtoExpert.new("reveille.malformed", "not a message", expert.group.MALFORMED, expert.severity.ERROR)
reveille.experts = { malformed }

-- An unsigned integer of variable length at `at`: its value, and the range it stands in.
local function varint(data, at)
    local first = data(at, 1):uint()
    if first < 251 then
        return first, data(at, 1)
    elseif first == 251 then
        return data(at + 1, 2):le_uint(), data(at, 3)
    elseif first == 252 then
        return data(at + 1, 4):le_uint(), data(at, 5)
    elseif first == 253 then
        return data(at + 1, 8):le_uint64(), data(at, 9)
    end
    -- More than 64 bits: in hexadecimal digits, the high ones first.
    local high, low = data(at + 9, 8):le_uint64(), data(at + 1, 8):le_uint64()
    return "0x" .. high:tohex() .. low:tohex(), data(at, 17)
end

local read = {}

-- Reads what `form` says at `at` into `tree`, and gives the place after it.
local function dissect(form, data, at, tree)
    return read[form[1]](form, data, at, tree)
end

function read.nothing(_, _, at)
    return at
end

function read.bool(form, data, at, tree)
    local value = data(at, 1):uint() == 1
    tree:add(fields[form[2]], data(at, 1), value)
    return at + 1
end

function read.byte(form, data, at, tree)
    tree:add(fields[form[2]], data(at, 1))
    return at + 1
end

function read.unsigned(form, data, at, tree)
    local value, range = varint(data, at)
    tree:add(fields[form[2]], range, value)
    return at + range:len()
end

function read.long(form, data, at, tree)
    local value, range = varint(data, at)
    if type(value) == "number" then
        value = UInt64.new(value)
    end
    tree:add(fields[form[2]], range, value)
    return at + range:len()
end

function read.longest(form, data, at, tree)
    local value, range = varint(data, at)
    tree:add(fields[form[2]], range, tostring(value))
    return at + range:len()
end

function read.signed(form, data, at, tree)
    local value, range = varint(data, at)
    if type(value) == "number" then
        local half = math.floor(value / 2)
        value = Int64.new(value % 2 == 0 and half or -half - 1)
    else
        local half = value:rshift(1)
        value = value:band(1):tonumber() == 0 and Int64.new(half:lower(), half:higher()) or -Int64.new(half:lower(), half:higher()) - 1
    end
    tree:add(fields[form[2]], range, value)
    return at + range:len()
end

function read.single(form, data, at, tree)
    tree:add_le(fields[form[2]], data(at, 4))
    return at + 4
end

function read.double(form, data, at, tree)
    tree:add_le(fields[form[2]], data(at, 8))
    return at + 8
end

function read.text(form, data, at, tree)
    local length, range = varint(data, at)
    at = at + range:len()
    local value = length > 0 and data(at, length):string(ENC_UTF_8) or ""
    tree:add(fields[form[2]], length > 0 and data(at, length) or range, value)
    return at + length
end

function read.bytes(form, data, at, tree)
    local length, range = varint(data, at)
    at = at + range:len()
    if length > 0 then
        tree:add(fields[form[2]], data(at, length))
    end
    return at + length
end

function read.option(form, data, at, tree)
    if data(at, 1):uint() == 1 then
        return dissect(form[2], data, at + 1, tree)
    end
    return at + 1
end

function read.seq(form, data, at, tree)
    local length, range = varint(data, at)
    at = at + range:len()
    for _ = 1, length do
        at = dissect(form[2], data, at, tree)
    end
    return at
end

function read.all(form, data, at, tree)
    for part = 2, #form do
        at = dissect(form[part], data, at, tree)
    end
    return at
end

function read.choice(form, data, at, tree)
    local which, range = varint(data, at)
    local variant = form[3][which]
    if not variant then
        error("no such choice")
    end
    tree:add(fields[form[2]], range, variant[1])
    return dissect(variant[2], data, at + range:len(), tree)
end

-- The name of a sender or receiver; `number` belongs to the one that `kind` addresses.
local function party(name, kind, number)
    local single = name:gsub("^one ", "")
    return number and single == kind.addressee and single .. " " .. number or name
end

function reveille.dissector(data, packet, root)
    local kind = kinds[data(0, 1):uint()]
    local tree = root:add(reveille, data())
    packet.cols.protocol = "Reveille"
    if not kind then
        tree:add_proto_expert_info(malformed)
        return
    end
    tree:add_le(header.tti, data(6, 8))
    tree:add(header.plane, data(0, 1), kind.plane)
    tree:add(header.kind, data(0, 1), kind.name)
    -- The text of `reveille inspect tail`, after its length.
    local text_length = data(14, 2):le_uint()
    local start = 16 + text_length
    local text = text_length > 0 and data(16, text_length):string(ENC_UTF_8) or ""
    tree:add(header.text, data(14, 2 + text_length), text)
    tree:add(header.bytes, data(start), data:len() - start)
    local number = data(1, 1):uint() == 1 and data(2, 4):le_uint() or nil
    packet.cols.src = party(kind.from, kind, number)
    packet.cols.dst = party(kind.to, kind, number)
    local info = "TTI " .. tostring(data(6, 8):le_uint64()) .. " " .. kind.plane .. " " .. kind.name
    if number then
        info = info .. " " .. kind.addressee .. " " .. number
    end
    packet.cols.info = info .. ": " .. text
    local body = tree:add(fields[kind.name], data(start))
    if number and kind.needs_number_field then
        body:add_le(fields[kind.name .. "." .. kind.addressee], data(2, 4))
    end
    local ok, read_to = pcall(function()
        assert(data(start, 1):uint() == version, "another version")
        return dissect(kind.form, data, start + 1, body)
    end)
    if not ok or read_to ~= data:len() then
        tree:add_proto_expert_info(malformed)
    end
end

DissectorTable.get("wtap_encap"):add(wtap.USER0, reveille)
