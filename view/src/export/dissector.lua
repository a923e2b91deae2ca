-- Dissects messages of Reveille in Wireshark and tshark.
--
--   reveille inspect export run.mcap --to pcapng --out run.pcapng
--   reveille inspect export --dissector reveille.lua
--   wireshark -X lua_script:reveille.lua run.pcapng
--
-- Or put it into the folder of personal Lua plugins. Filters: reveille.wake, reveille.wake.device == 7.

local reveille = Proto("reveille", "Reveille")
local fields, units, kinds = {}, {}, {}
--@version
local header = {
    tti = ProtoField.uint64("reveille.tti", "TTI"),
    plane = ProtoField.string("reveille.plane", "plane"),
    kind = ProtoField.string("reveille.kind", "kind"),
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

-- Values for the Info column, the field with the receiver's or sender's number, and the depth of the list being read.
local shown, number_field, lists = {}, "", 0
local MOST_SHOWN = 5

-- Adds the value of the field at `path` to the Info column. The TTI and the number are in it already.
local function show(path, value)
    local name = path:match("[^.]+$")
    if lists > 0 or #shown >= MOST_SHOWN or name == "tti" or name == number_field then
        return
    end
    if units[path] == "micro-units" then
        value = string.format("%g units", tonumber(tostring(value)) / 1e6)
    elseif type(value) == "number" and value ~= math.floor(value) then
        value = string.format("%.4g", value)
    end
    if units[path] == "m" then
        value = value .. " m"
    end
    table.insert(shown, (name == "is" and "" or name .. " ") .. tostring(value))
end

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
    show(form[2], value)
    return at + 1
end

function read.byte(form, data, at, tree)
    tree:add(fields[form[2]], data(at, 1))
    show(form[2], data(at, 1):uint())
    return at + 1
end

function read.unsigned(form, data, at, tree)
    local value, range = varint(data, at)
    tree:add(fields[form[2]], range, value)
    show(form[2], value)
    return at + range:len()
end

function read.long(form, data, at, tree)
    local value, range = varint(data, at)
    if type(value) == "number" then
        value = UInt64.new(value)
    end
    tree:add(fields[form[2]], range, value)
    show(form[2], value)
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
    show(form[2], value)
    return at + range:len()
end

function read.single(form, data, at, tree)
    tree:add_le(fields[form[2]], data(at, 4))
    show(form[2], data(at, 4):le_float())
    return at + 4
end

function read.double(form, data, at, tree)
    tree:add_le(fields[form[2]], data(at, 8))
    show(form[2], data(at, 8):le_float())
    return at + 8
end

function read.text(form, data, at, tree)
    local length, range = varint(data, at)
    at = at + range:len()
    local value = length > 0 and data(at, length):string() or ""
    tree:add(fields[form[2]], length > 0 and data(at, length) or range, value)
    show(form[2], value)
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
    show(form[3], "× " .. length)
    lists = lists + 1
    for _ = 1, length do
        at = dissect(form[2], data, at, tree)
    end
    lists = lists - 1
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
    show(form[2], variant[1])
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
    tree:add(header.bytes, data(14), data:len() - 14)
    local number = data(1, 1):uint() == 1 and data(2, 4):le_uint() or nil
    packet.cols.src = party(kind.from, kind, number)
    packet.cols.dst = party(kind.to, kind, number)
    local info = "TTI " .. tostring(data(6, 8):le_uint64()) .. " " .. kind.plane .. " " .. kind.name
    if number then
        info = info .. " " .. kind.addressee .. " " .. number
    end
    local body = tree:add(fields[kind.name], data(14))
    if number and kind.needs_number_field then
        body:add_le(fields[kind.name .. "." .. kind.addressee], data(2, 4))
    end
    shown, number_field, lists = {}, number and kind.addressee or "", 0
    local ok, read_to = pcall(function()
        assert(data(14, 1):uint() == version, "another version")
        return dissect(kind.form, data, 15, body)
    end)
    packet.cols.info = info .. (#shown > 0 and ": " .. table.concat(shown, ", ") or "")
    if not ok or read_to ~= data:len() then
        tree:add_proto_expert_info(malformed)
    end
end

DissectorTable.get("wtap_encap"):add(wtap.USER0, reveille)
